"""`python -m cube_tensor_driver.cli`: what `./cube` runs."""

import os
import signal
import sys

from .main import INTERRUPTED, interrupt_again, main

if __name__ == "__main__":
    sys.unraisablehook = interrupt_again
    # SIGTERM raises KeyboardInterrupt like Ctrl-C, so that a command that is ended from outside
    # ends the processes that it has started.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = main()
        # If the reader has closed the pipe, this raises BrokenPipeError, which is handled below.
        sys.stdout.flush()
    except KeyboardInterrupt:
        # `main` handles Ctrl-C while the command runs; here it came while arguments were parsed.
        code = INTERRUPTED
    except BrokenPipeError:
        # The reader of the output has closed the pipe, as in ./cube urdf skin.yaml | head. Python
        # flushes stdout once more when it ends; without this redirection that would fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    sys.exit(code)
