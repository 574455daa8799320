"""The paper's claim about free matrices: trained, but of no use to a planner."""

import math
from collections.abc import Sequence

from contactgraph_studies.claim import Claim, ClaimNumber, verdict
from contactgraph_studies.claims_error import planned
from contactgraph_studies.declared import FULL_AB, GIM_TEMP, StudyTask
from contactgraph_studies.plan_cells import Source, Where
from contactgraph_studies.results import Results
from contactgraph_studies.words import joined, short

_UNBOUNDED = 10.0
"""Growth of the state over a run in which true states grow two- to threefold."""
_INFEASIBLE = 50.0
"""%: a controller that succeeds less often is no controller."""


def free_matrices(results: Results, tasks: Sequence[StudyTask]) -> Claim:
    """Claim 5."""
    numbers: list[ClaimNumber] = []
    found: list[bool | None] = []
    said = []
    for task in tasks:
        largest = {}
        for model in (FULL_AB, GIM_TEMP):
            where = Where(Source.growth, task.name, model.name, task.as_trained.name)
            for key, name in (
                ("growth_driven", "growth under the expert's control"),
                ("growth_free", "growth without control"),
            ):
                figure = results.growth(where, key)
                numbers.append(ClaimNumber(f"{model.name}, {name}", task.name, "times", figure))
            for key, name in (
                ("spectral_radius", "spectral radius of A, first step"),
                ("spectral_radius_max", "spectral radius of A, largest"),
            ):
                figure = results.growth(where, key)
                numbers.append(ClaimNumber(f"{model.name}, {name}", task.name, "", figure))
            largest[model] = results.derived(where, _largest_growth)
            for source, name in (
                (Source.planned, "success, planned a short way ahead"),
                (Source.long_plan, "success, planned a whole run ahead"),
            ):
                at = Where(source, task.name, model.name, task.as_trained.name)
                figure = results.number(at, "success_rate", 100.0)
                numbers.append(ClaimNumber(f"{model.name}, {name}", task.name, "%", figure))
        near = results.number(planned(task, FULL_AB, task.as_trained), "success_rate", 100.0)
        at = Where(Source.long_plan, task.name, FULL_AB.name, task.as_trained.name)
        far = results.number(at, "success_rate", 100.0)
        if not (largest[FULL_AB].known and near.known and far.known):
            found.append(None)
            continue
        unbounded = largest[FULL_AB].median >= _UNBOUNDED
        infeasible = max(near.median, far.median) < _INFEASIBLE
        found.append(unbounded and infeasible)
        grown = largest[FULL_AB].median
        told = "not finitely" if math.isinf(grown) else f"{short(grown)} times"
        said.append(
            f"{task.name}: rolled out over a whole run its states grow {told} "
            f"(GIM-Temp's {short(largest[GIM_TEMP].median)} times), and control succeeds in "
            f"{short(near.median)} % of the episodes planned a short way ahead, "
            f"{short(far.median)} % of those planned a whole run ahead"
        )
    return Claim(
        number=5,
        title="Full-AB trains, but LQR on it is infeasible: its rollouts grow without bound",
        quote="even though the model trained to convergence, using this learned model for LQR was "
        "infeasible […] resulting in unbounded behavior upon forward rollout",
        criterion=f"on every task predicted states grow at least {_UNBOUNDED:g} times over a whole "
        f"run, with or without control, and control succeeds in fewer than {_INFEASIBLE:g} % of "
        "the episodes, however far it plans",
        tasks=tuple(task.name for task in tasks),
        numbers=tuple(numbers),
        holds=verdict(found),
        sentence=f"{joined(said)}." if said else "Not measured.",
    )


def _largest_growth(values: dict) -> float:
    """The worse of the two ways to roll out; null is infinite."""
    grown = [values.get("growth_free"), values.get("growth_driven")]
    return max(math.inf if value is None else value for value in grown)
