"""`gscodec` in a process that stops itself at a named moment, and a capture for it to work on.

A moment is (where, n): the n-th step of a stage of training ("keyframe", "track", "fine-tune"), or the middle of the
n-th write of a file ("state", "checkpoint", "fragment", "index", "sequence").
"""

import os
import signal
import sys
from multiprocessing import get_context

import cv2  # noqa: F401
import scipy.spatial  # noqa: F401
import torch._dynamo  # noqa: F401  (optimizers import it; here it is imported once, not in every process)
from training import AS_SET

from bench.procedural import Scene, write_transforms
from bench.stress_scenes import walking
from gscodec import _native, progress
from gscodec import atomic_write as part_file
from gscodec.cli import main
from gscodec.commands import encode as encode_command
from gscodec.commands import train as train_command
from gscodec.encode import encode, writer
from gscodec.render import sensitivity
from gscodec.splats import sequence_writer
from gscodec.train import checkpoint, settings

TINY = {
    "keyframe_steps": 40,
    "motion_steps": 8,
    "finetune_steps": 4,
    "gaussians_max": 200,
    "initial_points": 150,
    "budget": AS_SET,
}


def write_capture(folder, frames=7):
    """A walking figure, 6 cameras, as transforms.json and PNG files."""
    write_transforms(Scene(walking, frames=frames, train=5, test=1, size=48).capture("walking"), folder)


def gscodec(*args, at=None, by=signal.SIGKILL) -> int:
    """Runs the command line, which gets the signal `by` at the moment `at`; returns the exit code, negative for a
    signal."""
    context = get_context("forkserver")
    context.set_forkserver_preload(["interrupting"])  # torch is slow to import
    process = context.Process(target=_run, args=([str(a) for a in args], at, by))
    process.start()
    process.join()
    return process.exitcode


def _run(args: list[str], at: tuple[str, int] | None, by: int) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore SIGINT
    settings.PRESETS["fast"], sensitivity.SIZE = TINY, 128
    if at:
        _arm(*at, lambda: os.kill(os.getpid(), by))
    sys.argv = ["gscodec", *args]
    main()


def _arm(where: str, n: int, stop) -> None:
    left = [n]

    def arrived(here: str) -> bool:
        left[0] -= here == where
        return here == where and left[0] == 0

    class Stopping(progress.Bar):
        def update(self, stage, done, total):
            if arrived(stage.split()[0]):
                stop()

    def half(name, write):
        """`write(path, data)` that stops half-way at the moment."""

        def written(path, *data):
            if arrived(name):
                path.with_name(path.name + ".part").write_bytes(b"half of it")
                stop()
            return write(path, *data)

        return written

    class Fragments(writer.StreamWriter):
        def append(self, payload, frames, *, sync, state):
            if arrived("fragment"):
                data = _native.fragment(payload, self.groups + 1, self.frames, frames, sync, self.config)
                self._file.write(data[: len(data) // 2])
                self._file.flush()
                stop()
            super().append(payload, frames, sync=sync, state=state)

        def finish(self, **k):
            if arrived("index"):
                self.out.with_name(self.out.name + ".indexed").write_bytes(b"half of it")
                stop()
            super().finish(**k)

    encode_command.Bar = train_command.Bar = Stopping
    writer.write_arrays = half("state", part_file.write_arrays)
    checkpoint.write_arrays = half("checkpoint", part_file.write_arrays)
    sequence_writer.write_ply = half("sequence", sequence_writer.write_ply)
    encode.StreamWriter = Fragments
