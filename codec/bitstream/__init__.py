"""Facts that the encoder and the decoder share: the attribute table and the levels. No algorithms."""
