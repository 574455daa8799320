"""The colours of still and moving pictures; `assets/page.css` has the page's."""

BODY_COLOURS = ("#1b66a8", "#cb5f12", "#7650a3", "#0d8074")
OTHER_COLOUR = "#a5a9ae"
BELIEF_COLOUR = "#b81f45"
CONTACT_COLOUR = "#f3dd9a"
GOAL_COLOUR = "#2c8a5c"
GROUND_COLOUR = "#f6f4ee"
SKELETON_COLOUR = "#d3d6da"
INK, SOFT, RULE = "#1d2127", "#616872", "#e2ded5"


def body_colour(node: int, involved: list[int]) -> str:
    """A colour for each body the run is about, one quiet colour for bystanders."""
    place = involved.index(node) if node in involved else len(BODY_COLOURS)
    return BODY_COLOURS[place] if place < len(BODY_COLOURS) else OTHER_COLOUR
