"""`python -m cube_tensor_driver.cli`: what `./cube` runs."""

import os
import signal
import sys

from .main import INTERRUPTED, interrupt_again, main

if __name__ == "__main__":
    sys.unraisablehook = interrupt_again
    # A command that is ended from outside ends the processes that it has started, as by Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = main()
        # Here a closed pipe is noticed while it can still be handled.
        sys.stdout.flush()
    except KeyboardInterrupt:
        # It came while the arguments were parsed.
        code = INTERRUPTED
    except BrokenPipeError:
        # The reader has closed the pipe, as in ./cube urdf skin.yaml | head. Python flushes stdout
        # once more when it ends, which must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    sys.exit(code)
