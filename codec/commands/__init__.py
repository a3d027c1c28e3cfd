"""One file a command: a command parses, calls one library function and prints.

Results go to stdout (`--json` for machines), progress to stderr. Modules that take long to import are imported inside
of the functions, so that `gscodec --help` is fast and the player's side needs no extra.
"""
