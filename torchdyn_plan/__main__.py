"""``python -m torchdyn_plan`` is ``torchdyn-plan``."""

from torchdyn_plan.cli import main

if __name__ == "__main__":
    main()
