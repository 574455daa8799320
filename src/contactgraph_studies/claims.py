"""All claims of the paper that the study can answer, in order."""

from collections.abc import Sequence

from contactgraph_studies.claim import Claim
from contactgraph_studies.claims_error import generalisation, more_data, small_in_distribution
from contactgraph_studies.claims_graph import corrected_edges, edges_mean_contact, prior_needed
from contactgraph_studies.claims_stability import free_matrices
from contactgraph_studies.declared import Amounts, StudyTask
from contactgraph_studies.results import Results


def claims(results: Results, tasks: Sequence[StudyTask], amounts: Amounts) -> list[Claim]:
    """One to seven; the third only where a task of it is among ``tasks``."""
    found = [
        small_in_distribution(results, tasks),
        generalisation(results, tasks),
        corrected_edges(results, tasks),
        free_matrices(results, tasks),
        prior_needed(results, tasks),
        edges_mean_contact(results, tasks),
    ]
    if any(task.with_samples for task in tasks):
        found.append(more_data(results, tasks, amounts))
    return sorted(found, key=lambda claim: claim.number)
