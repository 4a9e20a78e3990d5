"""Sets up everything that the project needs: a virtual environment with ROS 2, and both packages built into install/.

Usage: python3 tools/setup_environment.py [--for-tests]

With --for-tests it also builds the message packages below test/interfaces/, into build/test_interfaces, and has numba
compile the solver's loops.

Every step is skipped when its inputs have not changed since it last succeeded, so a second call takes seconds and an
interrupted one goes on where it stopped. This file stays free of new syntax, so that an old Python can still say what
is wrong.
"""

import sys

SUPPORTED = ((3, 10), (3, 13))


def main() -> None:
    if not SUPPORTED[0] <= sys.version_info[:2] <= SUPPORTED[1]:
        sys.exit(
            "setup: error: Python {}.{} to {}.{} is needed, but {} is {}.{}; name another one with "
            "`make PYTHON=/path/to/python3.12`".format(
                *(SUPPORTED[0] + SUPPORTED[1] + (sys.executable,) + tuple(sys.version_info[:2]))
            )
        )
    import environment

    environment.main(for_tests="--for-tests" in sys.argv[1:])


if __name__ == "__main__":
    main()
