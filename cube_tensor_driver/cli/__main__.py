"""`python -m cube_tensor_driver.cli`: what `./cube` runs."""

import os
import signal
import sys

from .main import interrupt_again, main

if __name__ == "__main__":
    sys.unraisablehook = interrupt_again
    # Ended from outside as by Ctrl-C: processes that a command started are ended too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = main()
        sys.stdout.flush()
    except KeyboardInterrupt:  # while the arguments were read
        code = 130
    except BrokenPipeError:
        # The reader has enough, as in ./cube urdf skin.yaml | head. What is left goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    sys.exit(code)
