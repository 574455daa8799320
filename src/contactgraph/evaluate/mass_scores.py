"""Scores of masses that a model infers from motion, against those that scenes tell."""

from statistics import NormalDist

import numpy as np

from contactgraph.data import Trajectory
from contactgraph.model import MassBelief, told_log_mass

PROBABILITY = 0.9
"""Of the interval whose coverage is measured."""
_QUANTILE = NormalDist().inv_cdf(0.5 * (1.0 + PROBABILITY))


def mass_errors(
    model: object, trajectory: Trajectory, masses: MassBelief | None
) -> np.ndarray | None:
    """[bodies, 2] error of the logarithm of the mass, and its standard deviation by the model.

    Of every body of unknown mass that touches another, at the end of its first contact, or of the
    trajectory. None where the model infers no masses, or the data tell none or no contacts.
    """
    contact = trajectory.contact
    if masses is None or contact is None:
        return None
    told, touched = told_log_mass(model, trajectory.scene), np.any(contact, axis=2)
    if told is None:
        return None
    unknown = np.asarray(masses.variance)[0, : touched.shape[1]] > 0.0
    found = []
    for node in np.flatnonzero(unknown & touched.any(axis=0)).tolist():
        begin = int(np.argmax(touched[:, node]))
        ended = np.flatnonzero(~touched[begin:, node])
        end = begin + int(ended[0]) if len(ended) else trajectory.steps
        error = float(masses.mean[end, node]) - told[node]
        found.append((error, float(masses.variance[end, node]) ** 0.5))
    return np.reshape(found, (-1, 2))


def mass_numbers(errors: np.ndarray | None) -> dict[str, float | None]:
    """Relative errors of masses after one contact, and the coverage of their 90 % intervals.

    ``errors`` as of `mass_errors`. None: not known.
    """
    names = "mass_error_median", "mass_error_p90", "mass_interval_coverage"
    if errors is None or not len(errors):
        return dict.fromkeys(names)
    relative = np.expm1(np.abs(errors[:, 0]))
    covered = np.abs(errors[:, 0]) <= _QUANTILE * errors[:, 1]
    values = np.median(relative), np.quantile(relative, 0.9), np.mean(covered)
    return {name: float(value) for name, value in zip(names, values, strict=True)}
