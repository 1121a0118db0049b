"""What a check found, in words and numbers."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Finding:
    """One thing to mend.

    Attributes:
        kind: a word for programs, for example ``poses_inverted``; all of them are in ``KINDS``.
        says: what is wrong, one sentence.
        change: what to change, one sentence.
        file: the file or option to change.
        frames: names of the frames concerned; empty where all are.
    """

    kind: str
    says: str
    change: str
    file: str
    frames: tuple[str, ...] = ()


KINDS = {
    "poses_transposed": "matrices are written transposed",
    "poses_inverted": "poses are world-to-camera",
    "poses_rotation_transposed": "rotations are world-to-camera, translations are camera centres",
    "poses_translation_inverted": "rotations are camera-to-world, translations are world-to-camera",
    "poses_opengl": "OpenGL's and OpenCV's camera axes are confused",
    "poses_axes": "camera axes are permuted or turned",
    "poses_left_handed": "poses are left-handed",
    "poses_scaled": "rotations are multiplied by a factor",
    "poses_order": "poses are in another order than the frames",
    "poses_shifted": "poses belong to other frames",
    "poses_still": "all poses are the same, while depth changes",
    "poses_count": "there are more or fewer poses than frames",
    "pose_unit": "translations are in another unit than depth",
    "depth_unit": "depth is in another unit than translations",
    "unit": "depth and translations are both in another unit",
    "depth_along_ray": "depth is the distance along the ray",
    "depth_shifted": "depth maps belong to other frames",
    "depth_mirrored": "depth maps are mirrored",
    "depth_clipped": "depth is clipped nearly everywhere",
    "depth_size": "depth maps have another size than photos",
    "intrinsics_size": "the calibration is of another image size",
    "intrinsics_scale": "intrinsics are of another resolution",
    "focal_length": "focal lengths are off",
    "principal_point": "the principal point is off",
    "images_mirrored": "photos and depth maps are mirrored, or poses left-handed",
    "photos_mirrored": "photos are mirrored",
    "photos_shifted": "photos belong to other frames",
    "photos_offset": "photos lie beside their depth maps",
    "photos_unrelated": "photos do not show what depth maps show",
    "disagreement": "frames disagree under every reading",
    "duplicate": "frames that repeat the one before",
    "blank": "frames whose photos show nothing",
    "blurred": "frames far less sharp than their neighbours",
    "mistimed": "frames whose pose, photo or depth belongs to another frame",
    "misregistered": "frames whose pose, photo or depth fits no neighbour",
}


@dataclass(frozen=True)
class Report:
    """The result of a check.

    Attributes:
        sequence: what was checked, in words.
        findings: what to mend; empty where everything agrees.
        notes: what could not be judged, and what is worth knowing.
        measures: rows (what, value as written, value as it should be read), for a table.
    """

    sequence: str
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    measures: tuple[tuple[str, str, str], ...]

    @property
    def consistent(self) -> bool:
        """Whether there is nothing to mend."""
        return not self.findings

    @property
    def verdict(self) -> str:
        """One sentence."""
        if self.consistent and not self.measures:
            return "There is too little to judge."
        if self.consistent:
            return "Poses, intrinsics, depth and photos agree."
        count = len(self.findings)
        return f"Not consistent: {count} thing{'s' * (count > 1)} to mend."

    def to_dict(self) -> dict:
        """JSON-ready content."""
        return {
            "sequence": self.sequence,
            "consistent": self.consistent,
            "verdict": self.verdict,
            "findings": [asdict(finding) for finding in self.findings],
            "notes": list(self.notes),
            "measures": [dict(zip(("what", "written", "best"), row, strict=True)) for row in self.measures],
        }

    def __str__(self) -> str:
        lines = [f"{self.sequence}", self.verdict]
        lines += [f"  [{f.kind}] {f.says} → {f.change}" for f in self.findings]
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])
