"""The report page, animations and summary figures of trajectories."""

from contactgraph.viz.animation import check_animation as check_animation
from contactgraph.viz.animation import write_animation as write_animation
from contactgraph.viz.cost_picture import cost_figure as cost_figure
from contactgraph.viz.edge_beliefs import BeliefTimeline as BeliefTimeline
from contactgraph.viz.edge_beliefs import belief_timeline as belief_timeline
from contactgraph.viz.edge_beliefs import most_changed_edge as most_changed_edge
from contactgraph.viz.report import write_report as write_report
from contactgraph.viz.report_data import LossCurve as LossCurve
from contactgraph.viz.report_data import NStepError as NStepError
from contactgraph.viz.report_data import ReliabilityCurve as ReliabilityCurve
from contactgraph.viz.report_data import ReportData as ReportData
from contactgraph.viz.report_data import ReportMetric as ReportMetric
from contactgraph.viz.scene_trajectory import SceneTrajectory as SceneTrajectory
from contactgraph.viz.scene_trajectory import recorded_scene as recorded_scene
from contactgraph.viz.scene_trajectory import scene_trajectory as scene_trajectory
from contactgraph.viz.summary_figure import write_summary_figure as write_summary_figure
