"""Which edges, bodies and moments of a run are worth a reader's time."""

import numpy as np

from contactgraph.viz.scene_run import SceneRun

_WORTH_SHOWING = 0.2
_BELIEVED = 0.5
_SHOWN_EDGES = 4


def leading_edges(run: SceneRun, limit: int = _SHOWN_EDGES) -> list[int]:
    """Edges that ever matter, most important first, at most ``limit``.

    An edge matters if it is ever truly in contact or its belief ever exceeds 0.2. True contacts
    come first, then by the largest and the mean belief.
    """
    largest, mean = _largest(run.belief), _mean(run.belief)
    touched = np.zeros(run.edge_count) if run.contact is None else run.contact.mean(axis=0)
    order = np.lexsort((-mean, -largest, -touched))
    return [int(e) for e in order if touched[e] > 0 or largest[e] > _WORTH_SHOWING][:limit]


def focus_nodes(run: SceneRun) -> list[int]:
    """The two bodies that the run is about, an actuated one first; one body where none touch."""
    leading = leading_edges(run, limit=1)
    if leading:
        first, second = (int(node) for node in run.edges[leading[0]])
        swap = bool(run.actuated[second]) and not run.actuated[first]
        return [second, first] if swap else [first, second]
    return [int(np.argmax(run.actuated))]


def involved_nodes(run: SceneRun) -> list[int]:
    """The focus, then every other body that is ever truly touched or is believed to be for long."""
    nodes = focus_nodes(run)
    mean = _mean(run.belief)
    for edge in leading_edges(run):
        if (mean[edge] > 0.05) if run.contact is None else run.contact[:, edge].any():
            nodes += [int(node) for node in run.edges[edge] if int(node) not in nodes]
    return nodes


def grasp_step(run: SceneRun) -> int | None:
    """The first state in which the two bodies in focus touch: truly, or else by belief."""
    leading = leading_edges(run, limit=1)
    if not leading:
        return None
    if run.contact is not None and run.contact[:, leading[0]].any():
        return int(np.argmax(run.contact[:, leading[0]]))
    believed = run.belief[:, leading[0]] >= _BELIEVED
    return int(np.argmax(believed)) + 1 if believed.any() else None


def shown_directions(values: np.ndarray) -> list[np.ndarray]:
    """[T, N] each: what is drawn of parameters ``values`` [T, N, D].

    In the plane no direction is special, and their mean is drawn. In space the vertical is (bodies
    stand on something, and fall), so it is drawn beside the mean over the level directions.
    """
    if values.shape[-1] < 3:
        return [values.mean(axis=-1)]
    return [values[..., :2].mean(axis=-1), values[..., 2]]


def _largest(belief: np.ndarray) -> np.ndarray:
    return np.max(np.nan_to_num(belief, nan=0.0), axis=0)


def _mean(belief: np.ndarray) -> np.ndarray:
    return np.mean(np.nan_to_num(belief, nan=0.0), axis=0)
