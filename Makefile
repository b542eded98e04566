PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

# The uv on PATH, else one that pip brought, into an environment of its own where pip refuses to touch the system's.
define UV
$(shell for uv in uv "$(PYTHON) -m uv" .venv-uv/bin/uv; do $$uv --version >/dev/null 2>&1 && echo "$$uv" && break; done)
endef

export UV_LINK_MODE ?= copy
export UV_PYTHON_DOWNLOADS ?= never

.PHONY: demo test check lock uv clean

demo: $(STAMP)
	$(BIN)/torchdyn-plan evaluate --static ik --planners pursuit corner oracle meet --velocity 3 --episodes 100 --seed 0 --out runs/demo

# One thread a worker: two pools of threads on the same cores slow each other down.
test: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/pytest -q -n 2

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright
	OMP_NUM_THREADS=1 $(BIN)/pytest -q -n 2

lock: uv
	$(UV) pip compile pyproject.toml --extra cli --group dev --generate-hashes --no-emit-index-url --no-header --universal -q -o requirements.lock

$(STAMP): pyproject.toml requirements.lock
	@$(MAKE) --no-print-directory uv
	test -x $(BIN)/python || $(UV) venv --python "$(PYTHON)" .venv
	$(UV) pip install --python $(BIN)/python --require-hashes -r requirements.lock
	$(UV) pip install --python $(BIN)/python --no-deps --no-build-isolation -e .
	@touch $@

uv:
	@test -n "$(UV)" \
	  || $(PYTHON) -m pip install --quiet uv 2>/dev/null \
	  || { $(PYTHON) -m venv .venv-uv && .venv-uv/bin/pip install --quiet uv; } 2>/dev/null \
	  || $(PYTHON) -m pip install --quiet --user uv 2>/dev/null \
	  || $(PYTHON) -m pip install --quiet --user --break-system-packages uv

clean:
	rm -rf .venv .venv-uv .pytest_cache .ruff_cache .hypothesis dist build
