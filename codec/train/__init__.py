"""Capture -> GaussianSequence: keyframe, hash-grid motion, joint fine-tuning. Needs the extra `encode`."""
