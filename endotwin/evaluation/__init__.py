"""How well renderings of a twin match photos that it was not fitted to."""

from endotwin.evaluation.evaluation import Evaluation, evaluate

__all__ = ["Evaluation", "evaluate"]
