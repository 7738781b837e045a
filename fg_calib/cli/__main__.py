"""`python -m fg_calib.cli` is `fg-calib`."""

from fg_calib.cli import main

if __name__ == "__main__":
    main()
