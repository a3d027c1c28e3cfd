"""Capture -> GaussianSequence: keyframe, tracking by a node graph, joint fine-tuning. Needs the extra `encode`."""
