"""stub"""

from dataclasses import dataclass


@dataclass
class Report:
    def run(self): ...
