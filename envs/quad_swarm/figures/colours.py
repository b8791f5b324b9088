"""Colours of the robots and of the policies, and the style of all figures."""

from __future__ import annotations

from typing import Any

# Based on Okabe and Ito's palette for colour-blind readers, but darker for a contrast of at least 3:1 on white
COLOURS = ("#0072B2", "#C77700", "#008866", "#C2609A", "#3399D4", "#B84A00", "#8F8200", "#757575")
# Colours of learned policies, of rules to compare with, and of text
LEARNED, RULES, INK = "#B84A00", "#757575", "#333333"
# Obstacles are bodies without a colour of their own: their inside and their outline
OBSTACLE, OUTLINE = "#C9CCD1", "#8D939B"

# For figures of at least 7.5 inches, which a page shows at about 100 pixels per inch
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
    """Return the colour of the robot or policy with this index. Colours repeat after eight."""
    return COLOURS[index % len(COLOURS)]
