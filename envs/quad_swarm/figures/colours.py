"""Colours of the robots and of the policies, and the style of all figures."""

from __future__ import annotations

from typing import Any

# After Okabe and Ito's, which colour-blind people can tell apart; darker, for a contrast of 3:1 and more on white.
COLOURS = ("#0072B2", "#C77700", "#008866", "#C2609A", "#3399D4", "#B84A00", "#8F8200", "#757575")
# What is learned, what it is compared with, and text beside the data
LEARNED, RULES, INK = "#B84A00", "#757575", "#333333"

# For figures of 7.5 inches and more, which a page shows at about 100 pixels an inch
STYLE: Any = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": "#8A8A8A",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "lines.linewidth": 1.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "savefig.dpi": 130,
}


def colour_of(index: int) -> str:
    """The colour of the robot or policy with this index; colours repeat after eight."""
    return COLOURS[index % len(COLOURS)]
