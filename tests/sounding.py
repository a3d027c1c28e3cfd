"""Shared by the tests of sound: a tone whose frequency tells the time, and a stream with this tone."""

import wave

import numpy as np
from playing import FPS
from synthetic import blob, encode_sequence, moved

from gscodec.encode.audio import read_audio
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence

LOW, RISE = 200.0, 1000.0  # Hz at the start, Hz a second


def write_tone(path, seconds: float, rate: int = 44100) -> None:
    """A mono .wav file whose frequency rises linearly."""
    t = np.arange(int(seconds * rate)) / rate
    tone = 0.5 * np.sin(2 * np.pi * (LOW * t + RISE / 2 * t * t))
    with wave.open(str(path), "wb") as f:
        f.setparams((1, 2, rate, 0, "NONE", ""))
        f.writeframes((32767 * tone).astype("<i2").tobytes())


def read_tone(path) -> tuple[np.ndarray, int]:
    """Samples of the first channel of a .wav file, -1 to 1, and their rate."""
    with wave.open(str(path)) as f:
        channels, data = f.getnchannels(), np.frombuffer(f.readframes(f.getnframes()), "<i2")
        return data[::channels] / 32768, f.getframerate()


def told_time(samples: np.ndarray, rate: int) -> float:
    """Time (s) in the tone at the middle of `samples`, from their frequency."""
    up = np.flatnonzero((samples[:-1] < 0) & (samples[1:] >= 0))
    crossings = up + samples[up] / (samples[up] - samples[up + 1])
    middle = (crossings[0] + crossings[-1]) / 2
    frequency = (len(crossings) - 1) * rate / (crossings[-1] - crossings[0])
    return (frequency - LOW) / RISE - (middle - len(samples) / 2) / rate


def tone_stream(path, audio, *, groups=4, length=15, fps=FPS, **settings) -> None:
    """Writes a stream of a small blob with the sound of a file; None: without sound."""
    still = blob(60)
    frames = [moved(still, [0, 0.05 * t, 0], [0.01 * t, 0, 0]) for t in range(groups * length)]
    sequence = GaussianSequence(fps, [DenseGroup(frames[k * length : (k + 1) * length]) for k in range(groups)])
    config = stream_config(fps=fps, sh_degree=0, gaussians=60, frames=length)
    options = {"audio": read_audio(audio)} if audio else {}
    encode_sequence(sequence, path, config, EncodeSettings(quality=50, refine=0, **settings), **options)
