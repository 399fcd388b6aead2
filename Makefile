# Two commands matter: `make demo` and `make test`. Each needs only Python >= 3.10 and Rust.

PYTHON ?= python3
VENV := $(CURDIR)/.venv
BIN := $(VENV)/bin
OUT ?= demo
comma := ,

# one interpreter and one target folder for every step, so that cargo compiles nothing twice
export PYO3_PYTHON := $(BIN)/python
export CARGO_TARGET_DIR := $(CURDIR)/target
# cargo is not to look for the job server of a make that runs checks side by side: make keeps it from other programs
export CARGO_MAKEFLAGS :=
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# one version of each tool and library, so that no release of theirs fails a build (make constraints)
export PIP_CONSTRAINT := $(CURDIR)/packaging/constraints.txt
export NO_MKDOCS_2_WARNING := 1
ifneq ($(wildcard ../shared/data),)
export SEWFAST_DATA ?= $(abspath ../shared/data)
endif

RUST := $(shell find rust -name '*.rs' -o -name 'Cargo.toml') Cargo.toml Cargo.lock
BUILT := $(VENV)/built.stamp
REPORT := $(VENV)/report.stamp
LIBRARIES := $(VENV)/libraries.stamp
DEV := $(VENV)/dev.stamp
MARKED := test test-core nightly lint rust-lint rust-test rust-units rust-rest no-std c-test python-lint types stubs \
  python-test computing waiting budgets python-core docs package package-source board release-bits night-laws \
  night-bits night-logs night-computing night-waiting night-budgets

.DEFAULT_GOAL := help
.PHONY: help dev demo pictures publishable accuracy assumptions battery strangers commissioning tracking pmsm moves positions axes joints drives faults nonsense motors fleet interrupts fuzz-logs mutations screens studio studio-hour studio-kills bits bode notches physics aarch64 constraints licences killed parting laws instructions bench bench-parts counts bench-device firmware clean $(MARKED)

help: ## this list
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 14

demo: $(REPORT) ## the whole experiment on the virtual machine; the report goes to demo/report.html
	$(BIN)/sewfast demo --out $(OUT)

$(OUT)/results.json: | $(REPORT)
	$(BIN)/sewfast demo --out $(OUT)

dev: $(DEV) ## builds and installs what the checks need (--jobs=2: in parallel)

# compilers side by side: one that optimises a crate keeps one processor busy
SYNC := $(if $(filter output-sync,$(.FEATURES)),--output-sync=target)
test: ## every check of the day; ends with pytest's summary, which names what is left to `make nightly`
	$(MAKE) --no-print-directory --jobs=2 $(SYNC) dev $(PASSED)/rust-units-$(SEED) board
# package first: clippy sets pyo3 up in another way than maturin, and each compiles it anew after the other
	$(MAKE) --no-print-directory --jobs=2 $(SYNC) package $(PASSED)/rust-rest-$(SEED) rust-lint python-lint no-std c-test
	$(MAKE) --no-print-directory computing
# tests that wait leave processors to the checks of types
	$(MAKE) --no-print-directory --jobs=2 waiting types stubs
	$(MAKE) --no-print-directory budgets

test-core: ## the crates and the package without documentation, extras, ports and browser
	$(MAKE) --no-print-directory --jobs=2 $(SYNC) dev rust-units
	$(MAKE) --no-print-directory python-core

# an hour at the most; what takes longer goes on where the night before stopped. One that fails keeps no other from running.
NIGHT := target/nightly
nightly: $(DEV) board ## the long proofs: counts, every page, emulated boards, browser, wheel from source, a portion of laws and bits
	$(MAKE) --no-print-directory --keep-going counts release-bits night-laws night-bits night-logs night-computing night-waiting night-budgets

night-laws: $(DEV)
	$(BIN)/python tests/support/laws.py --state $(NIGHT)/laws --minutes 8

night-bits: $(DEV)
	$(BIN)/python tests/support/deployed.py --state $(NIGHT)/bits --minutes 8

night-logs: $(DEV)
	$(BIN)/python tests/support/fuzzed_logs.py --seconds 20 --seed $(SEED)

night-computing: $(DEV)
	$(PYTEST) --nightly -m '$(COMPUTES)'

night-waiting: $(DEV)
	$(PYTEST) --nightly -m alone

night-budgets: $(DEV)
	$(ONE_BY_ONE) --nightly -m budget

release-bits: package-source ## the wheel as released has the bits of the build that the tests use
	target/package/venv/bin/python -I tests/support/bits.py > target/package/released.json
	$(BIN)/python -I tests/support/bits.py > target/package/built.json
	cmp target/package/released.json target/package/built.json

lint: rust-lint python-lint types stubs ## formatting, clippy, ruff, mypy, stubs

rust-lint: $(DEV)
	cargo fmt --all --check
	cargo clippy --workspace --all-targets --profile built --quiet -- -D warnings

python-lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(DEV)
	nice $(BIN)/mypy

stubs: $(DEV)
	MYPYPATH=python nice $(BIN)/python -m mypy.stubtest --allowlist tests/support/stubtest.txt sewfast._core

# the seed of every property, in Rust and in Python, comes from the commit: a build that passed passes again, and the next
# commit tries others
SEED ?= $(shell printf '%d' "0x$$(git rev-parse HEAD 2>/dev/null | cut -c1-8 | grep . || echo 1)")

# `make test` runs Rust's tests anew where their sources or the seed have changed: else they would do the same again
PASSED := target/passed
# (a folder is newer where a file of it is gone; what changes while they run is newer than their beginning)
$(PASSED)/%-$(SEED): $(shell find rust tests/golden) Cargo.toml Cargo.lock
	mkdir -p $(PASSED) && touch $@.begun
	$(MAKE) --no-print-directory $*
	mv $@.begun $@

rust-test: rust-units rust-rest ## unit, property and documentation tests of the crates (SEED=N; by default of the commit)

# What depends on the core takes it as the extension has compiled it; the core's own tests are compiled for themselves.
WITH_CORE := sewfast-core sewfast-control
rust-units:
	@echo "properties with PROPTEST_RNG_SEED=$(SEED)"
	PROPTEST_RNG_SEED=$(SEED) cargo test $(WITH_CORE:%=--package %) --tests --profile checked --quiet

rust-rest: $(DEV)
	PROPTEST_RNG_SEED=$(SEED) cargo test --workspace $(WITH_CORE:%=--exclude %) --profile built --quiet
	cargo test --workspace --doc --profile built --quiet

fleet: $(DEV) ## 2,000 recordings on one worker, on two, and with a worker killed every 10 s
	$(BIN)/python benches/fleet.py

interrupts: $(DEV) ## Ctrl-C, 20 times in each command that runs over 1 s: ended within 1 s, files whole, told truly (ONLY=tune,fleet, COUNT=)
	$(BIN)/python benches/interrupts.py $(if $(ONLY),--only "$(ONLY)") $(if $(COUNT),--count $(COUNT))

studio: $(DEV) ## the studio in a real browser: from a slider's event to painted plots, from Esc to output off
	$(BIN)/python benches/studio.py
	$(BIN)/python benches/studio_stops.py

screens: $(DEV) ## renders every step and state of the studio at four widths, light and dark, and measures it (target/screens; ONLY=word)
	$(BIN)/python tests/support/screens.py $(if $(ONLY),--only $(ONLY))

studio-hour: $(DEV) ## the studio through an hour of live signals: pictures a second, gaps, growth (SECONDS=3600)
	$(BIN)/python benches/studio_hour.py --seconds $(or $(SECONDS),3600)

studio-kills: $(DEV) ## browser killed, hung, frozen or closed, studio killed, link pulled: output off after (TRIALS=50)
	$(BIN)/python benches/studio_kills.py --trials $(or $(TRIALS),50)

fuzz-logs: $(DEV) ## damaged logs of every format, refused or read (COUNT=100000; SECONDS= for each; ONLY="mf4 tdms"; hours)
	$(BIN)/python tests/support/fuzzed_logs.py --count $(or $(COUNT),100000) $(if $(SECONDS),--seconds $(SECONDS)) $(if $(ONLY),--only $(ONLY))

mutations: $(DEV) ## changed files of sewfast's own nine formats, refused or used (COUNT=1000; SEED=; ONLY="model fleet")
	$(BIN)/python benches/mutations.py --count $(or $(COUNT),1000) --seed $(SEED) $(if $(ONLY),--formats $(ONLY))

bits: $(DEV) ## compares deployed code with the core over ten million samples of every kind (an hour)
	$(BIN)/python tests/support/deployed.py

instructions: $(DEV) ## counts instructions, code and memory of deployed code on an emulated Cortex-M4 (docs/deploy.md)
	$(BIN)/python tests/support/deployed.py --costs

laws: $(DEV) ## every property of the crates under 20 seeds with 10,000 cases each (two hours; SEEDS=, CASES=, ONLY=word; in parts: STATE=file MINUTES=)
	$(BIN)/python tests/support/laws.py $(if $(SEEDS),--seeds $(SEEDS)) $(if $(CASES),--cases $(CASES)) $(if $(ONLY),--only $(ONLY)) \
	  $(if $(STATE),--state $(STATE)) $(if $(MINUTES),--minutes $(MINUTES))

no-std: ## links the controller crate without the standard library, and its frames without a path that can panic
	cargo test --package sewfast-control --no-default-features --lib --profile built --quiet without_positions
	cargo build --package sewfast-control --profile firmware --quiet
	rustc --edition 2024 --crate-type staticlib -C panic=abort -D warnings \
	  --extern sewfast_control=target/firmware/libsewfast_control.rlib \
	  --out-dir target/bare rust/control/tests/bare/staticlib.rs
ifeq ($(shell uname),Linux)
	rustc --edition 2024 --crate-type cdylib -C panic=abort -C opt-level=s -C lto=fat -C embed-bitcode=yes -D warnings \
	  --extern sewfast_control=target/firmware/libsewfast_control.rlib -C link-args='-nostdlib -lc -Wl,-z,defs' \
	  --out-dir target/bare rust/control/tests/bare/no_panic.rs
endif

c-test: ## tests the C library and the example firmware, with board, motor and host in memory; no path panics
	cargo rustc --package sewfast-capi --features positions --profile firmware --crate-type staticlib --quiet
	mkdir -p target/bare
	$(CC) -std=c99 -Wall -Wextra -Werror -pedantic -O1 -I rust/capi/include -I examples/firmware \
	  -o target/bare/device_test rust/capi/tests/device.c examples/firmware/firmware.c \
	  target/firmware/libsewfast_capi.a -lm $(if $(filter Linux,$(shell uname)),-Wl$(comma)--gc-sections)
	target/bare/device_test
	$(CC) -std=c99 -Wall -Wextra -Werror -pedantic -O1 -I rust/capi/include -I examples/firmware \
	  -o target/bare/desk examples/firmware/desk.c examples/firmware/firmware.c \
	  target/firmware/libsewfast_capi.a -lm $(if $(filter Linux,$(shell uname)),-Wl$(comma)--gc-sections)
ifeq ($(shell uname),Linux)
	! nm target/bare/device_test | grep panicking
endif

ARM64 = aarch64-unknown-linux-gnu
aarch64: ## unit and property tests on an emulated 64-bit ARM (Debian: rustc-web rust-web-src gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user; CASES=16)
	RUSTC=/usr/bin/rustc RUSTDOC=/usr/bin/rustdoc RUSTC_BOOTSTRAP=1 PROPTEST_RNG_SEED=$(SEED) PROPTEST_CASES=$(or $(CASES),16) \
	  CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc \
	  CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER='qemu-aarch64 -L /usr/aarch64-linux-gnu' \
	  cargo test --package sewfast-control --package sewfast-core --lib --profile checked --quiet -Zbuild-std --target $(ARM64)

constraints: ## packaging/constraints.txt, the newest versions that fit together (needs uv)
	uv pip compile pyproject.toml --extra dev --extra docs --extra bench --extra release --universal --python-version 3.10 \
	  --upgrade --no-annotate --no-emit-index-url -o packaging/constraints.txt

licences: ## LICENSE-THIRD-PARTY, from the licences of the crates in a wheel
	$(PYTHON) tests/support/licences.py

killed: $(DEV) firmware ## kills the host of the emulated board 100 times; its output goes off in time
	SEWFAST_TRIALS=100 $(BIN)/python -m pytest tests/system/test_emulated.py -k killed

OLDEST := $(shell sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
board:
	@if [ -x /usr/bin/rustc ] && printf '%s\n' 'rustc $(OLDEST)' "$$(/usr/bin/rustc --version)" | sort --version-sort --check=silent && [ -d /usr/lib/rustlib/src/rust ] && command -v arm-none-eabi-gcc >/dev/null; then $(MAKE) --no-print-directory firmware; \
	else echo 'no compilers for the emulated boards here, or rustc before $(OLDEST) (see make firmware): their checks are left out'; fi

# the library is the M4's: an M7 runs it as it is, and its external memory lies elsewhere
M4 = thumbv7em-none-eabihf
firmware: ## the example firmware for emulated boards, Cortex-M4 and M7 (Debian: rustc-web rust-web-src gcc-arm-none-eabi libnewlib-arm-none-eabi)
	RUSTC=/usr/bin/rustc RUSTC_BOOTSTRAP=1 cargo rustc --package sewfast-capi --profile firmware --crate-type staticlib \
	  --quiet -Zbuild-std=core --target $(M4)
	mkdir -p target/bare
	set -e; for board in mps2-an386:cortex-m4:fpv4-sp-d16:0x21000000 mps2-an500:cortex-m7:fpv5-sp-d16:0x60000000; do \
	  set -- $$(echo $$board | tr : ' '); \
	  arm-none-eabi-gcc -mcpu=$$2 -mthumb -mfloat-abi=hard -mfpu=$$3 -O2 -std=c99 -Wall -Wextra -Werror \
	    -nostartfiles -Wl,--gc-sections,-z,noexecstack,--defsym=EXTERNAL=$$4 -T examples/firmware/mps2/board.ld \
	    -I rust/capi/include -I examples/firmware -o target/bare/$$1.elf \
	    examples/firmware/mps2/board.c examples/firmware/firmware.c \
	    $(or $(CARGO_TARGET_DIR),target)/$(M4)/firmware/libsewfast_capi.a -lm; \
	  arm-none-eabi-size target/bare/$$1.elf; \
	done

# first the tests that compute, then those that wait (beside compilers, or tests of time budgets, some come too late), then those
# that compute until their time is over: they take every processor, and one by one
ONE_BY_ONE := $(BIN)/python -m pytest --hypothesis-seed=$(SEED)
PYTEST := $(ONE_BY_ONE) -n 2 --dist worksteal
COMPUTES := not alone and not budget
python-test: ## pytest, with the snippets of the documentation and every example
	$(MAKE) --no-print-directory computing
	$(MAKE) --no-print-directory waiting
	$(MAKE) --no-print-directory budgets

computing: $(DEV)
	$(PYTEST) -m '$(COMPUTES)'

waiting: $(DEV)
	$(PYTEST) -m alone

budgets: $(DEV)
	$(ONE_BY_ONE) -m budget

# every test of the day and of the list, with the lines that each reaches; budgets take the time that they have
PARTED := $(CURDIR)/target/parting
parting: $(VENV)/bench.stamp ## writes tests/night.txt: which tests of over half a second are left to the night (quarter of an hour)
	rm -rf $(PARTED) target/seconds && mkdir -p $(PARTED)
	for part in '$(COMPUTES)' alone; do SEWFAST_ALL_DAY=1 COVERAGE_FILE=$(PARTED)/lines $(PYTEST) -m "$$part" --cov --cov-append --cov-context=test \
	  --cov-config=tests/support/coverage.ini --cov-report= || exit 1; done
	$(BIN)/python tests/support/parting.py target/seconds $(PARTED)/lines

CORE_TESTS := $(addprefix tests/,analysis control dataset evidence files greybox identification models tuning) \
  $(wildcard tests/test_*.py) tests/plugins/test_plugins.py
python-core: $(DEV)
	$(PYTEST) -m '$(COMPUTES)' $(CORE_TESTS)

docs: $(DEV) ## the site, in site/index.html; works offline
	$(BIN)/python docs/build.py
	$(BIN)/mkdocs build --strict --quiet

# the wheel of what is installed here already, imported where only numpy is; the source archive must have every file that
# it was compiled from (a build from the archive alone takes minutes: package-source)
package: $(DEV) ## wheel -> import in a clean environment; source archive is whole
	rm -rf target/package && mkdir -p target/package
	$(BIN)/maturin sdist --out target/package
	$(BIN)/python packaging/archive.py target/package/sewfast-*.tar.gz target/built/lib_core.d
	VIRTUAL_ENV=$(VENV) $(BIN)/maturin build --profile built --quiet --out target/package/wheels
	$(CLEAN_IMPORT)

package-source: $(DEV) ## source archive -> wheel as released -> import in a clean environment
	rm -rf target/package && mkdir -p target/package
	$(BIN)/maturin sdist --out target/package
	tar -xzf target/package/sewfast-*.tar.gz -C target/package
	$(BIN)/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir target/package/wheels target/package/sewfast-*/
	$(CLEAN_IMPORT)

define CLEAN_IMPORT
	$(PYTHON) -m venv target/package/venv
	target/package/venv/bin/pip install --quiet target/package/wheels/sewfast-*.whl
	cd target/package/venv && bin/python -I $(CURDIR)/tests/support/clean_import.py
endef

# actionlint is no Python package: it is asked where it is installed
publishable: package-source $(VENV)/release.stamp ## checks the parts of a release: archives, crates, workflows (twine, cargo publish --dry-run, zizmor, actionlint)
	$(BIN)/twine check --strict target/package/sewfast-*.tar.gz target/package/wheels/*.whl
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.renovate renovate.json
	$(BIN)/zizmor --offline .github/workflows
	if command -v actionlint; then actionlint; else echo 'actionlint is not installed; the workflows have been checked by their schema only'; fi
	cargo publish --dry-run --workspace --no-verify --allow-dirty

bench: $(VENV)/bench.stamp ## sewfast and its rivals in one run; writes docs/PERFORMANCE.md (QUICK=1, ONLY=word)
	$(BIN)/python benches/performance.py $(if $(QUICK),--quick) $(if $(ONLY),--only $(ONLY))

bench-parts: $(VENV)/bench.stamp ## every benchmark by itself, with its spread (pytest-benchmark)
	$(BIN)/python -m pytest benches --benchmark-enable --benchmark-only -o python_files='bench_*.py' -s

pictures: $(DEV) $(OUT)/results.json ## draws the checked-in pictures of README and pages from demo/
	$(BIN)/python docs/pictures.py $(OUT)

accuracy: $(DEV) ## accuracy of the default configuration on public recordings, compared with published figures (SEWFAST_DATA)
	$(BIN)/python benches/accuracy.py

battery: $(VENV)/bench.stamp ## identify on simulated systems of known truth (SPLIT=rules|held|all, FAMILIES=, SEEDS=, RUNS=, QUICK=1)
	$(BIN)/python benches/battery.py --cache target/battery.json $(if $(SPLIT),--split $(SPLIT)) \
	  $(if $(FAMILIES),--families $(FAMILIES)) $(if $(SEEDS),--seeds $(SEEDS)) $(if $(RUNS),--runs $(RUNS)) \
	  $(if $(QUICK),--quick) $(if $(JSON),--json $(JSON))

assumptions: $(DEV) ## unstable plants in loops, single steps, coloured noise, seeds, shifts (COUNT=20)
	$(BIN)/python benches/assumptions.py $(if $(COUNT),--count $(COUNT))

strangers: $(DEV) ## takes twelve files in users' formats to a controller with three commands (SEEDS="0 1", ONLY=counts,iso)
	$(BIN)/python benches/strangers.py $(if $(SEEDS),--seeds $(SEEDS)) $(if $(ONLY),--only $(ONLY))

commissioning: $(DEV) ## commissioning on five virtual machines, compared with an oracle (docs/RESULTS.md)
	$(BIN)/python benches/commissioning.py

bode: $(VENV)/bench.stamp ## frequency responses and shafts of machines whose truth is known (docs/bode.md)
	$(BIN)/python benches/bode.py
	$(BIN)/python benches/bode.py --held --count 20
	$(BIN)/python benches/records.py --held
	$(BIN)/python benches/records.py --held --feedback

notches: $(VENV)/bench.stamp ## gain of a notch on machines with a shaft (docs/bode.md)
	$(BIN)/python benches/notches.py
	$(BIN)/python benches/notches.py --held --again --count 20

physics: $(VENV)/bench.stamp ## parameters of motors whose truth is known (docs/physics.md)
	$(BIN)/python benches/physics.py --count 40 --mujoco 20 --logs 200 --tracked 24

tracking: $(VENV)/bench.stamp ## what a feedforward is worth, beside simple-pid and a linear-quadratic regulator (SEEDS=5 MACHINES=8)
	$(BIN)/python benches/tracking.py $(if $(SEEDS),--seeds $(SEEDS)) $(if $(MACHINES),--machines $(MACHINES))

pmsm: $(VENV)/bench.stamp ## commissioning on motulator's synchronous motor with vector control, beside its own speed controller and simple-pid (SEEDS="0 1")
	$(BIN)/python benches/pmsm.py $(if $(SEEDS),--seeds $(SEEDS))

moves: $(VENV)/bench.stamp ## what a table of a known move brings, and what repetitions add (SEEDS=5 MACHINES=8, MOTORS=20 of MuJoCo, MODEL=grey_box, RUNS=200 on changed machines)
	$(BIN)/python benches/moves.py $(if $(MOTORS),--motors $(MOTORS)) $(if $(MODEL),--model $(MODEL)) $(if $(SEEDS),--seeds $(SEEDS)) $(if $(MACHINES),--machines $(MACHINES)) $(if $(RUNS),--runs $(RUNS))

positions: $(VENV)/bench.stamp ## stops at an angle and standstill on virtual machines (SEEDS=1 MACHINES=8 STOPS=100 MODEL=grey_box)
	$(BIN)/python benches/positions.py $(if $(MODEL),--model $(MODEL)) $(if $(SEEDS),--seeds $(SEEDS)) $(if $(MACHINES),--machines $(MACHINES)) $(if $(STOPS),--stops $(STOPS))

axes: $(VENV)/bench.stamp ## position loops on 20 axes of MuJoCo beside LinuxCNC's autotuned pid (Debian's linuxcnc-uspace, if it is there; ONLY="0 4")
	$(BIN)/python benches/axes.py $(if $(ONLY),--only $(ONLY))

joints: $(VENV)/bench.stamp ## positions: drives like EMPS, smart servos and MuJoCo joints (KIND=servos SEEDS="0 1" PHYSICS=1 HELD=1; SAGE=folder of real motions, TRAIN=multisine)
	$(BIN)/python benches/joints.py $(if $(SAGE),--sage $(SAGE)) $(if $(TRAIN),--train $(TRAIN)) $(if $(KIND),--kind $(KIND)) $(if $(SEEDS),--seeds $(SEEDS)) $(if $(PHYSICS),--physics) $(if $(HELD),--held)

drives: $(VENV)/bench.stamp ## commissioning on drives of another simulator (ONLY="shaft60 lash", SEEDS=)
	$(BIN)/python benches/drives.py $(if $(ONLY),--only $(ONLY)) $(if $(SEEDS),--seeds $(SEEDS))

faults: $(VENV)/bench.stamp board ## commissioning on drives, motors of MuJoCo and a board with 30 faults: ended in time, never verified, named (ONLY=word, STATE=file to go on with, DRIVES=12 MOTORS=7 BOARDS=1)
	$(BIN)/python benches/faults.py $(if $(ONLY),--only "$(ONLY)") $(if $(STATE),--out $(STATE)) \
	  $(if $(DRIVES),--drives $(DRIVES)) $(if $(MOTORS),--motors $(MOTORS)) $(if $(BOARDS),--boards $(BOARDS))

nonsense: $(DEV) ## records that deceive and good ones: praised, named, accused (COUNT=2 of each kind, ONLY=word)
	$(BIN)/python benches/nonsense.py $(if $(COUNT),--count $(COUNT)) $(if $(ONLY),--only "$(ONLY)")

motors: $(DEV) ## commissioning on 20 motors of MuJoCo, compared with an oracle (ONLY="3 7", SEEDS=)
	$(BIN)/python benches/mujoco_motors.py $(if $(ONLY),--only $(ONLY)) $(if $(SEEDS),--seeds $(SEEDS))

SOAKED := $(shell grep -rl --include='test_*.py' 'import FULL' tests)

soak: $(DEV) ## every case, seed and second of the tests that take a part otherwise: faults, kills, flips, hostile bytes, searches (hours)
	SEWFAST_SOAK=1 cargo test --package sewfast-control --package sewfast-link --profile built --quiet
	SEWFAST_SOAK=1 $(BIN)/python -m pytest -s $(SOAKED)
	SEWFAST_SOAK=1 $(BIN)/python -m pytest -s --nightly $(SOAKED)

counts: $(DEV) ## compares the kernels' instruction counts with those in benches/counts.json (valgrind; Linux)
	$(BIN)/python benches/counts.py

bench-device: ## time of a control period of the device on this computer
	cargo run --release --quiet --package sewfast-control --example device_step

clean: ## removes everything that was built, including the virtual environment
	rm -rf target site demo dist $(VENV)
	rm -f python/sewfast/_core*.so
	find benches docs examples python tests -name __pycache__ -prune -exec rm -rf {} +

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	  { echo 'Python 3.10 or newer is needed; name one: make PYTHON=python3.12'; exit 1; }
	@command -v cargo >/dev/null || { echo 'Rust is needed: https://rustup.rs'; exit 1; }
	$(PYTHON) -m venv $(VENV)

# numpy as well: maturin installs what sewfast itself needs, and not while another pip does
$(VENV)/maturin.stamp: | $(VENV)/bin/python
	$(BIN)/pip install --quiet 'maturin>=1.9,<2' numpy
	@touch $@

$(BUILT): $(RUST) pyproject.toml | $(VENV)/maturin.stamp
	@echo 'compiling the core; the first time this takes some minutes'
	@# pip would name every extra that is not asked for
	PIP_QUIET=1 VIRTUAL_ENV=$(VENV) $(BIN)/maturin develop --profile built --quiet
	@touch $@

# sewfast itself is there already, so that pip only adds what its extras name
$(REPORT): $(BUILT)
	$(BIN)/pip install --quiet 'sewfast[report,link]'
	@touch $@

# with --jobs=2 while the core is compiled, which keeps one processor busy; to compile all that is never imported takes as
# long as to install it
$(LIBRARIES): pyproject.toml packaging/constraints.txt | $(VENV)/maturin.stamp
	$(BIN)/python packaging/extras.py dev docs > $(VENV)/libraries.txt
	$(BIN)/pip install --quiet --no-compile -r $(VENV)/libraries.txt
	@touch $@

$(DEV): $(BUILT) $(LIBRARIES)
	$(BIN)/pip install --quiet 'sewfast[dev,docs]'
	@touch $@

$(VENV)/release.stamp: $(DEV)
	$(BIN)/pip install --quiet 'sewfast[release]'
	@touch $@

$(VENV)/bench.stamp: $(DEV)
	$(BIN)/pip install --quiet 'sewfast[bench]'
	@touch $@
