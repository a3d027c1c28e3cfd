"""`make player`: codec/native -> player/native.wasm.gz; player.js and what it imports -> page.js, which index.html
loads; and the hash of what each was built from (native.sha256, page.sha256).
`make spark`: three.js and Spark, of the versions and hashes in spark/package-lock.json -> spark.js, and its hashes.

All are committed, so that a checkout and the wheel play offline and without toolchains; a test fails when a hash is
stale. The first needs the wasm32-unknown-unknown target (rustup fetches it), or the sources of the standard library:
where rustup cannot be used, Debian's rustc-web, cargo-web and rust-web-src will do. Both need npm.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PLAYER = Path(__file__).resolve().parent
NATIVE = PLAYER.parent / "codec" / "native"
TARGET = "wasm32-unknown-unknown"
WASM, HASH = PLAYER / "native.wasm.gz", PLAYER / "native.sha256"
BINARYEN = "132.0.0"  # whose wasm-opt makes the module a tenth smaller
ZOPFLI = "1.0.15"  # a twentieth smaller than zlib
PACK = """const fs = require("fs");
require("@gfx/zopfli").gzip(fs.readFileSync(0), {}, (e, data) => { if (e) throw e; fs.writeFileSync(1, data); });"""
# Instructions up to which a function that is called in one place goes into its caller: what is called for each Gaussian
# stays by itself, since a browser optimises a function from its next call on.
INLINED_MAX = 40
FEATURES = "simd bulk-memory sign-ext mutable-globals nontrapping-float-to-int reference-types multivalue".split()
PAGE, PAGE_HASH = PLAYER / "page.js", PLAYER / "page.sha256"
LATER = ["gpu.js", "parts.js", "sound.js", "spark.js"]  # which the page loads when it needs them
SPARK, SPARK_HASH = PLAYER / "spark.js", PLAYER / "spark.sha256"


def source_hash() -> str:
    """SHA-256 over the sources of native.wasm.gz."""
    files = [NATIVE / "Cargo.toml", NATIVE / "Cargo.lock", NATIVE / "bindings" / "src" / "lib.rs"]
    files += [NATIVE / crate / "Cargo.toml" for crate in ("gsv", "raster", "bindings", "cores")]
    for folder in ("gsv/src", "raster/src", "cores/src", "bindings/src/wasm"):
        files += (NATIVE / folder).rglob("*.rs")
    files.append(NATIVE / "bindings" / "src" / "wasm.rs")
    digest = hashlib.sha256()
    for f in sorted(files):
        data = f.read_bytes()
        digest.update(f"{f.relative_to(NATIVE).as_posix()} {len(data)}\n".encode() + data)
    return digest.hexdigest()


def build() -> None:
    """Builds native.wasm.gz: packed, since few static hosts pack wasm.

    Raises:
        SystemExit: the toolchain is missing or the build fails.
    """
    command = ["cargo", "build", "--quiet", "--profile", "wasm", "--target", TARGET, "-p", "bindings"]
    command += ["--no-default-features", "--features", "wasm"]
    flags = ["-C target-feature=+simd128", "-C link-arg=--strip-all", *_remaps()]
    env = dict(os.environ, RUSTFLAGS=" ".join(flags))
    if not _has_target():
        command += ["-Z", "build-std=std,panic_abort"]
        env |= {"RUSTC_BOOTSTRAP": "1", "CARGO_TARGET_WASM32_UNKNOWN_UNKNOWN_LINKER": "rust-lld"}
    if subprocess.run(command, cwd=NATIVE, env=env).returncode:
        sys.exit(f"error: the wasm build failed; it needs the Rust target {TARGET} (rustup target add {TARGET})")
    folder = Path(os.environ.get("CARGO_TARGET_DIR", NATIVE / "target"))
    built = folder / TARGET / "wasm" / "gscodec_native.wasm"
    WASM.write_bytes(_optimized(built))
    HASH.write_text(source_hash() + "\n")
    print(f"{WASM.name}: {WASM.stat().st_size / 1000:.0f} kB")


def _optimized(module: Path) -> bytes:
    """The module as wasm-opt makes it, packed by zopfli; npm fetches both.

    Raises:
        SystemExit: npm is missing or fails.
    """
    _need_npm("wasm-opt comes with it")
    with tempfile.TemporaryDirectory() as folder:
        packages = f"binaryen@{BINARYEN} @gfx/zopfli@{ZOPFLI}"
        install = f"npm install --silent --ignore-scripts --no-fund --no-audit --prefix . {packages}".split()
        out, program = Path(folder) / "out.wasm", Path(folder) / "node_modules" / ".bin" / "wasm-opt"
        optimize = [program, "-O2", "--one-caller-inline-max-function-size", str(INLINED_MAX)]
        optimize += [*(f"--enable-{f}" for f in FEATURES), module, "-o", out]
        if subprocess.run(install, cwd=folder).returncode or subprocess.run(optimize).returncode:
            sys.exit(f"error: wasm-opt of {packages} was not fetched or failed")
        packed = Path(folder) / "out.wasm.gz"
        with out.open("rb") as plain, packed.open("wb") as to:
            subprocess.run(["node", "-e", PACK], cwd=folder, stdin=plain, stdout=to, check=True)
        if gzip.decompress(packed.read_bytes()) != out.read_bytes():
            sys.exit(f"error: what zopfli of {packages} has packed is not the module")
        return packed.read_bytes()


def page_modules() -> list[Path]:
    """The sources of page.js."""
    return [f for f in sorted(PLAYER.glob("*.js")) if f.name not in (PAGE.name, "worker.js", *LATER)]


def page_hashes() -> str:
    """SHA-256 over the sources of page.js, and of page.js."""
    return _hashes(page_modules(), PAGE)


def spark_hashes() -> str:
    """SHA-256 over the sources of spark.js, and of spark.js."""
    return _hashes(sorted((PLAYER / "spark").iterdir()), SPARK)


def _hashes(sources: list[Path], made: Path) -> str:
    digest = hashlib.sha256()
    for f in sources:
        digest.update(f.name.encode() + b"\n" + f.read_bytes())
    return f"{digest.hexdigest()} {hashlib.sha256(made.read_bytes()).hexdigest()}"


def build_page() -> None:
    """Builds page.js, in which the modules are one file without comments, half as large on the way to a browser.

    Raises:
        SystemExit: npm is missing.
        CalledProcessError: it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        modules = _installed(Path(folder))
        _esbuild(modules, PLAYER / "player.js", PAGE, *(f"--external:./{name}" for name in LATER))
    PAGE_HASH.write_text(page_hashes() + "\n")


def _need_npm(why: str) -> None:
    """Raises SystemExit if npm is missing."""
    if not shutil.which("npm"):
        sys.exit(f"error: npm was not found; {why} (Debian: apt-get install npm)")


def _installed(folder: Path) -> Path:
    """Copies spark/ to `folder` and installs what its lock file names: three.js, Spark and esbuild. Returns where."""
    _need_npm("page.js and spark.js are bundled with it")
    shutil.copytree(PLAYER / "spark", folder, dirs_exist_ok=True)
    subprocess.run("npm ci --ignore-scripts --no-fund --no-audit --silent".split(), cwd=folder, check=True)
    return folder / "node_modules"


def _esbuild(modules: Path, entry: Path, out: Path, *options: str) -> None:
    """Bundles `entry` and what it imports into `out`."""
    command = [modules / ".bin" / "esbuild", entry.name, "--bundle", "--minify", "--format=esm", "--target=es2022"]
    subprocess.run([*command, f"--outfile={out}", "--log-level=error", *options], cwd=entry.parent, check=True)
    print(f"{out.name}: {out.stat().st_size / 1000:.0f} kB")


def _has_target() -> bool:
    """Whether the target is installed, after asking rustup for it."""
    sysroot = subprocess.run(["rustc", "--print", "sysroot"], capture_output=True, text=True, check=True).stdout.strip()
    if (Path(sysroot) / "lib" / "rustlib" / TARGET / "lib").is_dir():
        return True
    if not shutil.which("rustup"):
        return False
    return subprocess.run(["rustup", "target", "add", TARGET]).returncode == 0


def _remaps() -> list[str]:
    """Compiler flags that keep the folders of this machine out of the module."""
    home = Path(os.environ.get("CARGO_HOME", Path.home() / ".cargo"))
    folders = [*(home / "registry" / "src").glob("*"), NATIVE]
    return [f"--remap-path-prefix={f}={'crates' if f != NATIVE else 'native'}" for f in folders]


def build_spark() -> None:
    """Builds spark.js, with the licences of its parts at the top.

    Raises:
        SystemExit: npm is missing.
        CalledProcessError: it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        modules = _installed(Path(folder))
        names = ("three", "@sparkjsdev/spark")
        licences = [f"{name}\n\n{(modules / name / 'LICENSE').read_text()}" for name in names]
        banner = "/*! Bundled by `make spark` from:\n\n" + "\n".join(licences) + "*/"
        _esbuild(modules, Path(folder) / "entry.js", SPARK, f"--banner:js={banner}", "--legal-comments=none")
    SPARK_HASH.write_text(spark_hashes() + "\n")


def check_committed() -> None:
    """Raises SystemExit if the files in the repository are not those of its sources."""
    if not HASH.exists() or HASH.read_text().strip() != source_hash():
        sys.exit(
            "error: player/native.wasm.gz was built from other sources; run `make player` and commit player/native.*"
        )
    if not PAGE_HASH.exists() or PAGE_HASH.read_text().strip() != page_hashes():
        sys.exit("error: player/page.js was made from other modules; run `make player` and commit player/page.*")
    if not SPARK_HASH.exists() or SPARK_HASH.read_text().strip() != spark_hashes():
        sys.exit("error: player/spark.js is not that of player/spark; run `make spark` and commit player/spark.*")


if __name__ == "__main__":
    if "--spark" in sys.argv[1:]:
        build_spark()
    else:
        if "--committed" in sys.argv[1:]:  # CI: the committed files must be current, and the tests run on rebuilt ones
            check_committed()
        build()
        build_page()
