"""A twin in the files of other programs."""

from endotwin.export.export import FORMATS, check_export, export

__all__ = ["FORMATS", "check_export", "export"]
