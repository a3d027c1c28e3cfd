# `make demo` and `make test` do all the set-up themselves: they need python3 (>= 3.10), cargo and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NATIVE := $(shell find codec/native -name '*.rs' -not -path '*/target/*') codec/native/Cargo.toml codec/native/Cargo.lock
CARGO := cd codec/native && cargo
DEMO := demo
DIST := dist

# What CI has besides: Ray, splat-transform, PlayCanvas, an emulator of the processors that have NEON. It does two things
# at a time there, since much of the building is one thread.
TOOLS := $(CURDIR)/build/tools
CI_TESTS := $(if $(CI),tools neon fuzz committed)
CI_ENV := $(if $(CI),PATH="$(TOOLS)/node_modules/.bin:$$PATH")
ifdef CI
EXTRAS := encode,charts,bench,dev,ray
MAKEFLAGS += --jobs=2
else
EXTRAS := encode,charts,bench,dev
endif
NEON := aarch64-unknown-linux-gnu
EMULATED := CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc \
	CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="qemu-aarch64 -L /usr/aarch64-linux-gnu"
APT := apt-get update -qq >/dev/null && DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends

.PHONY: venv demo test rust lint format bench wheel player spark browser tools neon fuzz committed clean
venv: $(VENV)/.done

# Once: the environment. Again: only when dependencies or the native code change.
$(VENV)/.done: pyproject.toml $(NATIVE)
	@command -v cargo >/dev/null || { echo "error: cargo was not found; install a Rust toolchain (rustup.rs) and run make again"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[$(EXTRAS)]'
	@touch $@

demo: venv
	@mkdir -p $(DEMO)
	$(BIN)/gscodec encode examples/lumberjack $(DEMO)/lumberjack.gsv
	$(BIN)/gscodec eval $(DEMO)/lumberjack.gsv examples/lumberjack
	$(BIN)/gscodec render $(DEMO)/lumberjack.gsv $(DEMO)/preview.mp4
	@echo
	@echo "The stream is $(DEMO)/lumberjack.gsv, a preview $(DEMO)/preview.mp4. To play and to go on:"
	@echo "  $(BIN)/gscodec play $(DEMO)/lumberjack.gsv                           in the browser, from any side"
	@echo "  $(BIN)/gscodec info $(DEMO)/lumberjack.gsv                           what is in it"
	@echo "  $(BIN)/gscodec render $(DEMO)/lumberjack.gsv out.mp4 --camera cam20  another view of it"
	@echo "  $(BIN)/gscodec decode $(DEMO)/lumberjack.gsv plys/                   .ply frames for any splat viewer"

test: venv lint rust browser $(CI_TESTS)
	$(CI_ENV) $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

# After clippy, which builds in the same folder.
rust: lint
	$(CARGO) test --profile quick --quiet --workspace --features bindings/wasm

# Programs that tests use, and that a developer may lack: their tests are skipped then. After the browser, since one
# installation of packages waits for no other.
tools: browser
	@command -v npm >/dev/null || { $(APT) npm >/dev/null; }
	@{ command -v qemu-aarch64 && command -v aarch64-linux-gnu-gcc; } >/dev/null \
		|| { $(APT) qemu-user gcc-aarch64-linux-gnu libc6-dev-arm64-cross >/dev/null; }
	npm install --silent --no-audit --no-fund --prefix $(TOOLS) @playcanvas/splat-transform@3 \
		playcanvas@$(shell sed -n 's/.*"playcanvas": "\(.*\)".*/\1/p' player/examples/package.json)

# The tests of the crates that have NEON or decode, on an emulated processor, but one about memory that draws 360 million
# pixels there.
neon: tools
	rustup target add $(NEON)
	$(CARGO:cargo=)$(EMULATED) cargo test --profile quick --quiet --target $(NEON) -p raster -p gsv -- \
		--skip parts_of_bounded_memory

# A short run of each fuzz target.
fuzz: venv
	$(BIN)/python -m bench.fuzz --seconds 40 --dry

# The page's module and script are those of the sources. After `neon`: one installation of a Rust target at a time.
committed: venv neon
	$(BIN)/python player/build.py --committed

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(CARGO) fmt --all --check
	$(CARGO) clippy --profile quick --quiet --workspace --all-targets --features bindings/wasm -- -D warnings

format: venv
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(CARGO) fmt --all

# The web player's decoder: codec/native -> player/native.wasm.gz, and its script: player/*.js -> player/page.js, which are
# committed. Needs npm, for wasm-opt and esbuild.
player:
	$(PYTHON) player/build.py

# The web player's GPU renderer: three.js and Spark -> player/spark.js, which is committed. Needs npm.
spark:
	$(PYTHON) player/build.py --spark

# A Chromium for the tests of the player, which say that they are skipped where there is none (and fail if CI is set).
browser:
	@command -v chromium >/dev/null || command -v google-chrome >/dev/null || [ -n "$$CHROMIUM" ] \
		|| { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && $(APT) chromium >/dev/null; } \
		|| echo "note: no Chromium, the player's browser tests will be skipped"

# A wheel that installs where there is no Rust.
wheel:
	$(PYTHON) -m pip wheel --quiet --no-deps -w $(DIST) .

bench: venv
	$(BIN)/python -m bench.run

clean:
	rm -rf $(VENV) build dist *.egg-info codec/*.so codec/native/target $(DEMO)
