"""Contact beliefs and inferred masses of a model along a trajectory.

Usage: python examples/04_contact_graph.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from contactgraph.envs import PickupExpert, PickupTask
from contactgraph.evaluate import model_diagnostics, run_episode
from contactgraph.model import load_model, shipped_model
from contactgraph.viz import scene_trajectory, write_summary_figure

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
model = load_model(shipped_model("pickup")).model
trajectory = run_episode(PickupTask(distractors=3), PickupExpert(), seed=3)

# measured=False: the model receives positions, velocities and forces, but no contacts.
diagnostics = model_diagnostics(model, trajectory, measured=False)

# Edge e joins the nodes edges[e]. This one has the largest belief at any time.
edge = int(diagnostics.belief.max(axis=0).argmax())
first, second = diagnostics.edges[edge]
names = trajectory.scene.node_name
print(f"{trajectory.scene.node_count} nodes, {len(diagnostics.edges)} edges; the most probable is")
print(f"{names[first]} - {names[second]}, with these estimates:")
print("  time  belief  true contact    1/m of each, 1/kg    k/m, 1/s^2    c/m, 1/s")

touch = int(trajectory.contact[:, first, second].argmax())
for t in [*range(touch - 3, touch + 3), trajectory.steps - 1]:
    # Entry t describes the step from t to t + 1; its contact is that at its end.
    inverse_mass = diagnostics.parameters.inverse_mass[t].mean(axis=-1)
    stiffness = diagnostics.parameters.stiffness_rate[t, second].mean()
    damping = diagnostics.parameters.damping_rate[t, second].mean()
    print(
        f"{t * model.dt:6.2f}  {diagnostics.belief[t, edge]:6.2f}  "
        f"{'yes' if trajectory.contact[t + 1, first, second] else 'no':12s}    "
        f"{inverse_mass[first]:6.2f} {inverse_mass[second]:6.2f}      "
        f"{stiffness:10.3f}  {damping:10.3f}"
    )

# The 0/1 graph of a step is where the belief is above one half.
graph = diagnostics.belief > 0.5
wrong = np.sum(graph != trajectory.contact[1:, diagnostics.edges[:, 0], diagnostics.edges[:, 1]])
print(f"of {graph.size} edges over the episode, {wrong} are wrong")

scene = scene_trajectory(model, "3 distractors", trajectory)
write_summary_figure(folder / "contact_graph.png", scene)
print(f"wrote {folder / 'contact_graph.png'}")
