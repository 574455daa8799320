"""stub"""

from dataclasses import dataclass


@dataclass
class Reproduce:
    def run(self): ...
