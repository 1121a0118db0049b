"""What a dataset is worth: networks trained on real and on rendered frames, and judged on others."""

from endotwin.study.arms import PARTS, parse_parts
from endotwin.study.run import Plan, study_depth

__all__ = ["PARTS", "Plan", "parse_parts", "study_depth"]
