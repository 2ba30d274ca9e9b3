# The two commands: `make demo`, `make test`. Everything is made in .venv, from the pins and hashes of constraints.txt.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DELETE_ON_ERROR:
.SILENT:
.PHONY: install install-dev demo test lint bench constraints clean distclean

PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3)
BIN := .venv/bin
UV := $(BIN)/uv
UV_INSTALL := $(UV) pip install --quiet --python $(BIN)/python --constraint constraints.txt --verify-hashes
# What open3d (and numba's OpenMP) loads and a minimal Debian or Ubuntu does not have.
SYSTEM := libgl1 libegl1 libx11-6 libusb-1.0-0 libgomp1

install: .stamps/product

install-dev: .stamps/dev

demo: .stamps/product
	$(BIN)/mineloc demo

test: .stamps/dev
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

lint: .stamps/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright
	$(BIN)/lint-imports

bench: .stamps/dev
	$(MAKE) -C benchmarks PYTHON=$(abspath $(BIN))/python

# Fresh pins; those that still fit stay as they are.
constraints: .stamps/venv
	$(UV) pip compile pyproject.toml --group dev --quiet --generate-hashes --no-header --no-annotate \
		--no-emit-index-url --no-emit-find-links \
		--python-version 3.11 --python-platform x86_64-manylinux_2_35 --output-file constraints.txt

clean:
	rm -rf demo reports/out build .pytest_cache .ruff_cache .hypothesis .import_linter_cache .coverage
	find mineloc flows tests -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv .stamps

# $(call system,what is missing,packages): installs them if this user may, else says the line to type.
define system
install="apt-get install --yes --no-install-recommends $(2)"
if ! command -v apt-get >/dev/null; then
	echo "$(1) is missing; install what Debian calls $(2)" >&2
	exit 1
elif [ "$$(id -u)" -eq 0 ]; then
	as_root="env DEBIAN_FRONTEND=noninteractive"
elif sudo -n true 2>/dev/null; then
	as_root="sudo env DEBIAN_FRONTEND=noninteractive"
else
	echo "$(1) is missing; type: sudo sh -c 'apt-get update && $$install'" >&2
	exit 1
fi
echo "installing $(2)"
if ! { $$as_root apt-get update && $$as_root $$install; } > .stamps/apt.log 2>&1; then
	cat .stamps/apt.log >&2
	exit 1
fi
endef

.stamps/venv: constraints.txt
	mkdir -p .stamps
	version=$$($(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])' || true)
	case "$$version" in
		3.11 | 3.12) ;;
		*) echo "Python 3.11 or 3.12 is needed, found $${version:-none}; type: make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)" >&2; exit 1 ;;
	esac
	if ! $(PYTHON) -c 'import ensurepip' 2>/dev/null; then
		$(call system,python3 -m venv,python$$version-venv)
	fi
	[ -x $(BIN)/python ] || $(PYTHON) -m venv .venv
	awk '/^[a-z]/ { found = /^uv==/ } found' constraints.txt > .stamps/uv.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --no-deps -r .stamps/uv.txt
	touch $@

.stamps/product: .stamps/venv pyproject.toml constraints.txt
	echo "installing mineloc in .venv"
	$(UV_INSTALL) --requirement pyproject.toml hatchling editables
	$(UV) pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation --editable .
	if ! $(BIN)/python -c 'import open3d' 2>/dev/null; then
		$(call system,a library of open3d,$(SYSTEM))
		$(BIN)/python -c 'import open3d'
	fi
	touch $@

.stamps/dev: .stamps/product
	$(UV_INSTALL) --requirement pyproject.toml --group dev
	touch $@
