"""Everything that the study of inference measures, task by task."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from contactgraph_studies.job import Job, Measurement, Variant
from contactgraph_studies.worlds import WORLDS, World, WorldAmounts, WorldTraining

FILTER = Variant("", "hidden Markov filter", ("--model", "filter"))
FIRST_FORM = Variant("gim-temp", "first form", ("--model", "gim-temp"))
SHIPPED = Variant("shipped", "shipped model")

EXACT = Variant("", "exact sensor")
LYING = Variant("lying", "5 % of the reports wrong", ("--false-alarms", "0.05", "--misses", "0.05"))
LATE = Variant("late", "reports two steps late", ("--delay", "2"))
PRIORS = tuple(
    Variant(f"prior-{name}", f"geometric prior: {name}", ("--inference", f"prior-{name}"))
    for name in ("touch", "hold")
)
"""In the place of inference, with the same dynamics: whatever is near touches, or is held."""
CONTROLLED = Variant("", "control")
LOSING = Variant("lose-grasp", "control, half of the grasps lost", ("--lose-grasp", "0.5"))
TEN_DISTRACTORS = Variant("10-distractors", "control among 10 distractors", ("--distractors", "10"))

HIDDEN = ("suction-hidden", "release", "delay", "sticky")
"""Tasks in which geometry does not tell the contact."""
COMMANDED = "suction"
"""The task with the switch in the control."""
KNOWN = ("pickup", "multi-pickup", "door")
"""Tasks in which geometry tells the contact."""
INFERENCE_WORLDS = tuple(
    world
    for slug in (*HIDDEN, COMMANDED, *KNOWN, "franka")
    for world in WORLDS
    if world.slug == slug
)


@dataclass(frozen=True)
class InferenceCondition:
    """The labels of a number in ``results.json``."""

    task: str
    """The slug of the world."""
    model: str
    """The name of `FILTER`, `FIRST_FORM` or `SHIPPED`."""
    measured: str
    """The name of the variant of sensor, inference or control."""


def inference_measurements(worlds: Sequence[World], amounts: WorldAmounts) -> list[Measurement]:
    """All jobs of a training, then those of the next one, task by task."""
    return [one for world in worlds for one in _of(world, amounts)]


def _of(world: World, amounts: WorldAmounts) -> Iterator[Measurement]:
    def measured(model: Variant, variant: Variant, seed: int, job: Job) -> Measurement:
        return Measurement(InferenceCondition(world.slug, model.name, variant.name), seed, job)

    scenes, first_seed = world.scenes[0], amounts.seeds[0]
    if world.slug not in (*HIDDEN, COMMANDED):
        shipped = replace(world, shipped_runs=world.shipped_runs or amounts.training_runs)
        job = WorldTraining(shipped, first_seed, amounts, SHIPPED).evaluation(scenes)
        yield measured(SHIPPED, EXACT, first_seed, job)
    for seed in () if world.shipped_runs else amounts.seeds:
        training = WorldTraining(world, seed, amounts, FILTER)
        # The network is fitted for as long as the model: of each task once, or it takes too long.
        baselines = world.slug in HIDDEN and seed == first_seed
        yield measured(FILTER, EXACT, seed, training.evaluation(scenes, EXACT, baselines))
        if world.slug in KNOWN or (world.slug in HIDDEN and seed == first_seed):
            first = WorldTraining(world, seed, amounts, FIRST_FORM).evaluation(scenes)
            yield measured(FIRST_FORM, EXACT, seed, first)
        if world.slug in HIDDEN:
            for variant in (*PRIORS, LYING, LATE):
                yield measured(FILTER, variant, seed, training.evaluation(scenes, variant))
            continue
        many = replace(training, world=replace(world, fast_control=True))
        variant = LOSING if world.slug == COMMANDED else CONTROLLED
        yield measured(FILTER, variant, seed, many.control(scenes, variant))
        if world.slug == "pickup":
            few = replace(training, world=replace(world, fast_control=False))
            yield measured(FILTER, TEN_DISTRACTORS, seed, few.control(scenes, TEN_DISTRACTORS))
