"""``python -m pipelines`` is ``animatic``."""

from pipelines.cli import main

if __name__ == "__main__":
    main()
