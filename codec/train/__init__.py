"""Capture -> groups of tracked Gaussians: keyframe, tracking, fine-tuning. Needs the extra `encode`."""
