"""How well renderings of a twin match photos that it was not fitted to."""

from endotwin.evaluation.evaluation import Evaluation, evaluate
from endotwin.evaluation.kept import keep_scores
from endotwin.evaluation.sheet import error_heat

__all__ = ["Evaluation", "error_heat", "evaluate", "keep_scores"]
