"""How well renderings of a twin match photos that it was not fitted to."""

from endotwin.evaluation.evaluation import Evaluation, evaluate
from endotwin.evaluation.kept import keep_scores

__all__ = ["Evaluation", "evaluate", "keep_scores"]
