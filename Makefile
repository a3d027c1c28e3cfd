# `make demo` and `make test` do all the set-up themselves: they need python3 (>= 3.10), cargo and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NATIVE := $(shell find codec/native -name '*.rs' -not -path '*/target/*') codec/native/Cargo.toml codec/native/Cargo.lock
CARGO := cd codec/native && cargo
DEMO := demo

.PHONY: venv demo test lint format bench clean
venv: $(VENV)/.done

# Once: the environment. Again: only when dependencies or the native code change.
$(VENV)/.done: pyproject.toml $(NATIVE)
	@command -v cargo >/dev/null || { echo "error: cargo was not found; install a Rust toolchain (rustup.rs) and run make again"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[encode,dev]'
	@touch $@

demo: venv
	@mkdir -p $(DEMO)
	$(BIN)/gscodec encode examples/lumberjack $(DEMO)/lumberjack.gsv
	$(BIN)/gscodec eval $(DEMO)/lumberjack.gsv examples/lumberjack
	$(BIN)/gscodec render $(DEMO)/lumberjack.gsv $(DEMO)/preview.mp4
	@echo
	@echo "The stream is $(DEMO)/lumberjack.gsv; watch $(DEMO)/preview.mp4. To go on:"
	@echo "  $(BIN)/gscodec info $(DEMO)/lumberjack.gsv                           what is in it"
	@echo "  $(BIN)/gscodec render $(DEMO)/lumberjack.gsv out.mp4 --camera cam20  another view of it"
	@echo "  $(BIN)/gscodec decode $(DEMO)/lumberjack.gsv plys/                   .ply frames for any splat viewer"

test: venv lint
	$(CARGO) test --release --quiet --workspace
	$(BIN)/python -m pytest

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(CARGO) fmt --all --check
	$(CARGO) clippy --release --quiet --workspace --all-targets -- -D warnings

format: venv
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(CARGO) fmt --all

bench: venv
	$(BIN)/python bench/run.py

clean:
	rm -rf $(VENV) build dist *.egg-info codec/*.so codec/native/target $(DEMO)
