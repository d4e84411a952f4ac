# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m cube_tensor_driver.cli`: what `./cube` runs."""

import errno
import os
import signal
import sys

from ..processes.stop_signals import INTERRUPTED
from .main import BROKEN_PIPE, interrupt_again, main

if __name__ == "__main__":
    sys.unraisablehook = interrupt_again
    # SIGTERM raises KeyboardInterrupt like Ctrl-C, so that a command that is ended from outside
    # ends the processes that it has started.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = main()
        # If stdout cannot be written, this raises OSError, which is handled below.
        sys.stdout.flush()
    except KeyboardInterrupt:
        # `main` handles Ctrl-C while the command runs, but not while arguments are parsed.
        code = INTERRUPTED
    except OSError as error:
        # Writing to stdout failed. (Errors of other files are CubeErrors, which `main` handles.)
        # Python flushes stdout again at its exit, so stdout is redirected to avoid a second error.
        if error.errno not in (errno.EPIPE, errno.ENOSPC):
            raise
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        code = 1
        if error.errno == errno.EPIPE:
            # The reader has closed the pipe, as in ./cube urdf skin.yaml | head.
            code = BROKEN_PIPE
        else:
            print(f"cube: stdout: {error.strerror}", file=sys.stderr)
    sys.exit(code)
