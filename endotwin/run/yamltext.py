"""YAML from files that others wrote: whatever is wrong with the text, the error is a ValueError."""

from __future__ import annotations

import yaml


def parsed(text: str) -> object:
    """The value that ``text`` holds. Raises ValueError where it is no YAML, or nested too deeply."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error
    except RecursionError:
        raise ValueError("its brackets are nested too deeply") from None
