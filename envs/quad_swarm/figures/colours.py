"""Colours of the robots and of the policies."""

# Okabe and Ito's, which colour-blind people can tell apart.
OKABE_ITO = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#999999")


def colour_of(index: int) -> str:
    """The colour of the robot or policy with this index; colours repeat after eight."""
    return OKABE_ITO[index % len(OKABE_ITO)]
