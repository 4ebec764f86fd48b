# Everything runs from a bare Debian 12 or 13 as root; what is missing is installed, and said, first.
#   LAB=container  system tests in a systemd-nspawn container (default)
#   LAB=vm         system tests in a machine with a kernel of its own
#   LAB=host       system tests right here, on a machine booted with systemd

LAB ?= container
export LAB PYTEST

PREPARE := tests/lab/prepare
CHECK := /usr/bin/python3 tests/lab/check

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*##/make \1:/p' $(MAKEFILE_LIST)

test:  ## everything: unit tests, system tests in the vm, system tests
	@$(PREPARE) $(if $(filter host,$(LAB)),host,container machines vm)
	@$(CHECK) test

check:  ## linters, types and unit tests, those of changed folders first; PYTEST="FILE -k WORD"
	@$(PREPARE)
	@$(CHECK) check

unit:  ## unit tests, on this machine's Python
	@$(PREPARE)
	@$(CHECK) unit

system:  ## system tests in $(LAB)
	@$(PREPARE) $(if $(filter vm,$(LAB)),container vm,$(LAB))
	@$(CHECK) system

quick:  ## the heart of the system tests, in less than two minutes
	@$(PREPARE) container
	@$(CHECK) quick

vm:  ## system tests that need a kernel of their own
	@$(PREPARE) container vm
	@$(CHECK) vm

emulator:  ## system tests that need Debian's kernel and two processors
	@$(PREPARE) container vm
	@$(CHECK) emulator

faults:  ## every fault of tests/system/faults, ROUNDS=n times
	@$(PREPARE) $(if $(filter vm,$(LAB)),container vm,container)
	@ROUNDS=$(ROUNDS) $(CHECK) faults

transcripts:  ## tasks as a person types them, and what is shown; LAB=forky: with the packages
	@$(PREPARE) container
	@$(CHECK) transcripts

history:  ## commands and faults in combination; SEED=n STEPS=n HOURS=n, LAB_OUT=DIR keeps records
	@$(PREPARE) $(if $(filter vm machines,$(LAB)),container $(LAB),container)
	@SEED=$(SEED) STEPS=$(STEPS) HOURS=$(HOURS) $(CHECK) history

stops:  ## STOPS=n stops of all kinds, and what a recorder loses; LAB=vm restarts the machine, too
	@$(PREPARE) $(if $(filter vm,$(LAB)),container vm,container)
	@STOPS=$(STOPS) $(CHECK) stops

kills:  ## kill -9 beside a recorder, ROUNDS=n times, and which messages a bundle has; SEED=n
	@$(PREPARE) container
	@ROUNDS=$(ROUNDS) SEED=$(SEED) $(CHECK) kills

power:  ## the power fails ROUNDS=n times in the middle of a deploy or rollback; SEED=n
	@$(PREPARE) container vm
	@ROUNDS=$(ROUNDS) SEED=$(SEED) $(CHECK) power

other-python:  ## unit tests of what touches the system, on the Python of the lab
	@$(PREPARE) container
	@$(CHECK) other-python

lab:  ## tests of the lab itself
	@$(PREPARE) container vm
	@$(CHECK) lab

packages:  ## the Debian packages: built, installed, used, through a reboot and a power cut
	@$(PREPARE) container vm
	@$(CHECK) packages

fuzz:  ## feed what reads other people's bytes, for SECONDS=n
	@$(PREPARE)
	@FUZZ_SECONDS=$(SECONDS) $(CHECK) fuzz

mutants:  ## change the product in SAMPLE=n places, chosen by SEED=n, and see whether unit tests notice
	@$(PREPARE)
	@SEED=$(SEED) SAMPLE=$(SAMPLE) $(CHECK) mutants

browser:  ## the status page in headless Chromium; LAB_OUT=DIR keeps pictures of it
	@$(PREPARE) container
	@$(CHECK) browser

openarm:  ## nodes of OpenArm from PyPI record a dataset, beside bare dora
	@$(PREPARE) container
	@$(CHECK) openarm

machines:  ## three machines on a network: doractl -H, pulled cables, power cuts
	@$(PREPARE) machines
	@$(CHECK) machines

BENCHMARKS := start stop recovery startup many gateway cost fleet logs messages reload deploy owes recorder machines spread

bench:  ## what supervision costs, against named rivals; WHAT="start ...", ROUNDS=n
	@$(PREPARE) container
	@for one in $(or $(WHAT),$(BENCHMARKS)); do \
	    case $$one in machines|spread) lab=machines;; *) lab=rivals;; esac; \
	    LAB=$$lab LAB_OUT=benchmarks/data tests/lab/lab run -- python -m benchmarks.$$one $(ROUNDS) || exit; done
	@/usr/bin/python3 -B -m benchmarks.report

bench-quick:  ## a few benchmarks in 3 minutes, their ratios beside the stored ones; WHAT="start ..."
	@$(PREPARE) container
	@LAB=rivals tests/lab/lab run -- python -m benchmarks.quick $(WHAT)

bench-platforms:  ## list and start of the packages on Debian 12, 13 and the next one, beside dora; ROUNDS=n
	@$(PREPARE) container
	@packaging/build --once
	@for one in bookworm container forky; do \
	    LAB=$$one LAB_OUT=benchmarks/data tests/lab/lab run -- \
	        tests/platforms/installed python -m benchmarks.platforms $(ROUNDS) || exit; done
	@/usr/bin/python3 -B -m benchmarks.report

bookworm:  ## the packages on Debian 12, with systemd 252, installed by apt, and wheels by uv
	@$(PREPARE) container
	@$(CHECK) bookworm

forky:  ## the same on the next Debian, with systemd 262
	@$(PREPARE) container
	@$(CHECK) forky

arm64:  ## the packages and wheels for arm64: built, installed and used, all emulated
	@$(PREPARE) container
	@$(CHECK) arm64

canary:  ## what differs with the newest dora on PyPI, or with VERSION=
	@$(PREPARE) container
	@VERSION=$(VERSION) $(CHECK) canary

lint:  ## ruff and mypy
	@$(PREPARE)
	@$(CHECK) lint

demo:  ## a real dataflow under systemd, from start to stop
	@$(PREPARE) $(if $(filter vm,$(LAB)),container vm,container)
	@tests/lab/lab run -- tests/demo

clean:  ## remove the images and venvs, and what killed runs left behind
	@tests/lab/lab clean

deb:  ## the Debian packages, built twice and checked, into dist/
	@$(PREPARE) container
	@packaging/build

wheels:  ## wheels of dora-systemd, pystemd and systemd-python, into dist/wheels, for uv and pipx; PYTHON=DIR
	@$(PREPARE) container
	@packaging/wheels $(PYTHON)

autopkgtest:  ## debian/tests, by Debian's own autopkgtest, on what make deb has built
	@$(PREPARE) $(if $(filter vm,$(LAB)),container vm,container)
	@packaging/autopkgtest

.PHONY: help test check unit other-python lab packages system quick vm emulator faults transcripts history stops power fuzz mutants browser openarm machines bench bench-quick bench-platforms bookworm forky arm64 canary lint demo clean deb wheels autopkgtest
