"""GaussianSequence -> bytes. Order, quantize, predict, entropy, mux."""
