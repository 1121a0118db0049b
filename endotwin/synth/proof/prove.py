"""A proof: pairs of frames, spread over the dataset, and all that their labels claim of each other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence.spread import spread
from endotwin.synth.proof.between import between
from endotwin.synth.proof.claims import Proof, Tally
from endotwin.synth.proof.warp import Frame
from endotwin.synth.proof.within import within
from endotwin.synth.proof.written import Written

PAIRS = 50
"""Pairs of frames that are judged, where a dataset has more."""


def prove(
    dataset: Written | Path | str, pairs: int = PAIRS, progress: Callable[[str, int, int], None] | None = None
) -> Proof:
    """Judge the labels of a dataset by its files alone.

    Args:
        dataset: its folder. pairs: of frames that follow each other, spread evenly; all where there are
            fewer. progress: called with (label, done, total).

    Raises:
        SequenceError: there is no dataset, or a file of it is missing or damaged.
    """
    written = dataset if isinstance(dataset, Written) else Written.open(dataset)
    firsts = spread(max(len(written) - 1, 1), pairs)
    tally, kept = Tally(), Frame(written, int(firsts[0]))
    threads = 1 if written.layout.packed else THREADS  # a tar is read at one place at a time
    try:
        for done, first in enumerate(firsts, 1):
            one = kept if kept.index == first else Frame(written, int(first))
            judging = [within(one)] if one is not kept or done == 1 else []
            if first + 1 < len(written):
                kept = Frame(written, int(first) + 1)
                judging += [within(kept), between(one, kept), between(kept, one)]
            for judged in ahead(list, judging, threads):
                tally.add(judged)
            if progress:
                progress("prove", done, len(firsts))
    finally:
        written.close()
    return tally.proof(len(written), len(firsts))
