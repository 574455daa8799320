"""What commands say about a learned cost."""

from contactgraph.control import LearnedCost, cost_terms

_LAST = 50
"""Steps over which the loss in the end is taken: each step sees other windows."""


def participant_lines(cost: LearnedCost) -> list[str]:
    """Who takes part in the task and who does not, and why."""
    lines = [f"kept     {each.name}: {each.reason}" for each in cost.participants if each.kept]
    reasons: dict[str, list[str]] = {}
    for each in cost.participants:
        if not each.kept:
            reasons.setdefault(each.reason, []).append(each.name)
    return lines + [f"dropped  {', '.join(names)}: {why}" for why, names in reasons.items()]


def term_lines(cost: LearnedCost) -> list[str]:
    """What the cost wants, how strongly, and how well it explains the demonstrations."""
    loss = cost.history.imitation
    terms = cost_terms(cost)
    width = max(len(term.name) for term in terms)
    lines = [
        f"{term.name:<{width}}  1 m costs as much as {term.position:.3g} N, "
        f"1 m/s as much as {term.velocity:.3g} N"
        for term in terms
    ]
    return [
        *lines,
        f"imitation loss  {float(loss[0]):.4f} at the beginning, "
        f"{float(loss[-_LAST:].mean()):.4f} in the end",
    ]
