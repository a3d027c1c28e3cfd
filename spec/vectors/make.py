"""Regenerator of the conformance vectors: writes valid/, invalid/ and manifest.json from the list of cases.

    python spec/vectors/make.py

VALID (valid_cases.py) and INVALID (invalid_cases.py) drive both this regenerator and tests/test_conformance.py. The
hashes in the manifest (clause 16 of gsv.md) are those of the reference decoder.
"""

import json
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
sys.path.insert(0, str(HERE.parent))
import reference_decoder as reference  # noqa: E402
from invalid_cases import INVALID  # noqa: E402
from valid_cases import VALID  # noqa: E402


def describe(data):
    """The manifest entry of a valid file, by the reference decoder; of a scene the tracks behind the first apart."""
    config, groups = reference.decode(data)
    others = [describe_track(reference.decode(data, k)[1]) for k in range(1, config.tracks)]
    facts = {"frames": sum(sample.frames for sample, _ in groups), "groups": describe_track(groups)}
    return facts | ({"tracks": others} if others else {})


def describe_track(groups):
    return [
        {
            "start_frame": sample.start_frame,
            "frames": sample.frames,
            "sync": sample.sync,
            "gaussians": len(group.positions),
            "sha256": reference.group_hash(group),
        }
        for sample, group in groups
    ]


def main():
    manifest, files = {"valid": [], "invalid": []}, {}
    for name, (about, build) in VALID.items():
        file = f"valid/{name}.gsv"
        files[file] = build()
        manifest["valid"].append({"file": file, "about": about} | describe(files[file]))
    for name, (error, reason, build) in INVALID.items():
        file = f"invalid/{name}.gsv"
        files[file] = build()
        manifest["invalid"].append({"file": file, "error": error, "reason": reason})
    for old in HERE.glob("*valid/*.gsv"):
        old.unlink()
    for file, data in files.items():
        (HERE / file).parent.mkdir(exist_ok=True)
        (HERE / file).write_bytes(data)
    (HERE / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")
    print(f"{len(VALID)} valid, {len(INVALID)} invalid")


if __name__ == "__main__":
    main()
