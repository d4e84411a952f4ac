"""`python -m cube_tensor_driver.cli`: what `./cube` runs."""

import signal
import sys

from .main import interrupt_again, main

if __name__ == "__main__":
    sys.unraisablehook = interrupt_again
    # Ended from outside as by Ctrl-C: processes that a command started are ended too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = main()
    except KeyboardInterrupt:  # while the arguments were read
        code = 130
    sys.exit(code)
