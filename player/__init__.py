"""The web player: the page and its wasm decoder (built by `make player`), and the server behind `gscodec play`."""
