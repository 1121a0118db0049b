"""How well renderings of a twin match photos that it was not fitted to."""

from endotwin.evaluation.evaluation import Evaluation, error_heat, evaluate
from endotwin.evaluation.kept import keep_scores

__all__ = ["Evaluation", "error_heat", "evaluate", "keep_scores"]
