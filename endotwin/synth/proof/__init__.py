"""The proof that a dataset's labels agree with each other: from its files alone, by its own words."""

from endotwin.synth.proof.claims import CLAIMS, Proof
from endotwin.synth.proof.prove import prove
from endotwin.synth.proof.written import Written

__all__ = ["CLAIMS", "Proof", "Written", "prove"]
