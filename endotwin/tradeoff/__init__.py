"""What accuracy costs in time, for one's own sequence: a ladder of runs, their Pareto front and its knee.

And what each effect buys: the same fit with it and without.
"""

from endotwin.tradeoff.ladder import LADDER, Rung, ladder
from endotwin.tradeoff.run import tradeoff

__all__ = ["LADDER", "Rung", "ladder", "tradeoff"]
