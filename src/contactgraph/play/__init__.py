"""A live page: a session that pages disturb, and the server that shows it."""

from contactgraph.play.session import Session as Session
from contactgraph.play.stage import Stage as Stage
from contactgraph.play.stage import StageParts as StageParts
from contactgraph.play.wishes import StageChoice as StageChoice
