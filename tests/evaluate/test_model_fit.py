"""A model meets data or a task of another kind: refused in one line that names the field."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from evaluation_worlds import DT, GluedBodies, by_model, random_run, scene_of

from contactgraph.data import Dataset, InvalidInputError
from contactgraph.envs import DoorTask, PickupTask
from contactgraph.evaluate import evaluate_open_loop, model_diagnostics
from contactgraph.model import PRESETS, ModelConfig
from contactgraph.model.scene import check_fit

ANCHOR = np.array([[np.nan, np.nan], [0.3, 0.4]])
HINGED, FREE = scene_of(2, anchor=ANCHOR), scene_of(2)


@pytest.fixture(scope="module")
def models():
    return {
        hinges: PRESETS["paper-literal"](
            ModelConfig(2, 2, DT, 0.085, 4, hinges=bool(hinges)), key=jax.random.key(0)
        )
        for hinges in (0, 1)
    }


def test_models_fit_their_own_kind(models) -> None:
    check_fit(models[1], HINGED, 2, "the data")
    check_fit(models[0], FREE, 2, "the data")
    # Anchors that are all NaN mean that no node has a hinge.
    check_fit(models[0], scene_of(2, anchor=np.full((2, 2), np.nan)), 2, "the data")
    # Models without a stated task are accepted.
    check_fit(GluedBodies(), scene_of(2, anchor=ANCHOR), 5, "the data")


@pytest.mark.parametrize(
    ("hinges", "scene", "size", "message"),
    [
        (
            1,
            FREE,
            2,
            "the model is for bodies on hinges, but the data has no anchor, the position ",
        ),
        (0, HINGED, 2, "the model has no hinges, but the data has an anchor; train a model on "),
        (0, replace(FREE, dt=0.1), 2, "the model is for dt 0.05 s, but the data has 0.1 s; "),
        (0, replace(FREE, dimension=3), 2, "the model is for dimension D 2, but the data has 3; "),
        (0, FREE, 0, "the model is for control size U 2, but the data has 0; they must agree"),
    ],
)
def test_a_mismatch_is_named_in_one_line(models, hinges, scene, size, message) -> None:
    with pytest.raises(InvalidInputError) as caught:
        check_fit(models[hinges], scene, size, "the data")
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_a_missing_anchor_is_reported_wherever_a_model_reads_data(models) -> None:
    bare = random_run(2, 5, 0)
    hung = random_run(2, 5, 0, anchor=ANCHOR)
    for trajectory, model in ((bare, models[1]), (hung, models[0])):
        with pytest.raises(InvalidInputError, match=r"the data has (no|an) anchor"):
            evaluate_open_loop(model, Dataset((trajectory,)), horizon_s=2 * DT)
        with pytest.raises(InvalidInputError, match=r"has (no|an) anchor"):
            model_diagnostics(model, trajectory)
    for task, model in ((PickupTask, models[1]), (DoorTask, models[0])):
        with pytest.raises(InvalidInputError, match=r"the task has (no|an) anchor"):
            by_model(model, task, 1, 0)
