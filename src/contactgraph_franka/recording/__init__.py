"""What a robot did, as a run that models are trained on."""

from contactgraph_franka.recording.assumed_block import AssumedBlock as AssumedBlock
from contactgraph_franka.recording.run_recorder import RunRecorder as RunRecorder
from contactgraph_franka.recording.smoothing import smoothed as smoothed
