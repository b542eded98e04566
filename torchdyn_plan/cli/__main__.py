"""``python -m torchdyn_plan.cli`` is ``torchdyn-plan``."""

from torchdyn_plan.cli import main

if __name__ == "__main__":
    main()
