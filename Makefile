PYTHON ?= python3
BIN := .venv/bin

# Set for other work in many a shell: packages from elsewhere would pass for installed, or be installed elsewhere.
unexport PYTHONPATH PYTHONHOME
export PIP_USER := 0
export UV_PYTHON_DOWNLOADS ?= never

.PHONY: demo test check docs torture lock environment clean

demo: environment
	$(BIN)/torchdyn-plan evaluate --static ik --planners pursuit corner oracle wait_and_drop --velocity 3 --episodes 100 --seed 0 --out runs/demo --overwrite

# One thread a worker: two pools of threads on the same cores slow each other down.
test: environment
	OMP_NUM_THREADS=1 $(BIN)/pytest -q -n 2 --dist worksteal -m "not slow"

check: environment
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright
	OMP_NUM_THREADS=1 $(BIN)/pytest -q -n 2 --dist worksteal

# The site, in build/site; any warning is an error.
docs: environment
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Every promise under hostile users, damaged files, full disks and crashes: half an hour. A killed run goes on.
torture: environment
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.torture --out runs/torture.json

# For the oldest Python of the project, whichever runs it.
lock:
	@"$(PYTHON)" tools/setup_environment.py uv
	.venv-uv/bin/uv pip compile pyproject.toml --extra cli --group dev --generate-hashes --no-emit-index-url --no-header --universal --python .venv-uv/bin/python --python-version 3.11 --no-cache -q -o requirements.lock

# A quick look when all is installed.
environment:
	@"$(PYTHON)" tools/setup_environment.py

clean:
	rm -rf .venv .venv-uv .pytest_cache .ruff_cache .hypothesis dist build
