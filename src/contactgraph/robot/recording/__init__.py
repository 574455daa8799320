"""What a robot did, as a run that models are trained on."""

from contactgraph.robot.recording.assumed_block import AssumedBlock as AssumedBlock
from contactgraph.robot.recording.run_recorder import RunRecorder as RunRecorder
from contactgraph.robot.recording.smoothing import smoothed as smoothed
