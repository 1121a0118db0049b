"""Scores are kept in the folder of the twin that they are of."""

from __future__ import annotations

import logging
from pathlib import Path

from endotwin.errors import OutputError
from endotwin.run.output import TWIN, check_free
from endotwin.twin import Twin

logger = logging.getLogger("endotwin")


def keep_scores(scores: dict, twin: Twin, folder: Path) -> bool:
    """Keep the scores in the twin's folder, unless another twin is there by now or one may only read it."""
    try:
        check_free(folder, True, TWIN)
    except OutputError as error:
        logger.warning("The scores are not kept in the twin: %s", error)
        return False
    current = Twin.load(folder)
    if current.seal != twin.seal:
        logger.warning("The scores are not kept: %s was replaced while it was scored", folder)
        return False
    current.with_record(eval=scores).save(folder, overwrite=True)
    return True
