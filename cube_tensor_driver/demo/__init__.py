"""The demo: a simulated skin in real processes, measured against what was sent.

`demo` starts the processes, `watching` shows and measures what arrives, `verification` and
`load_verification` compare it with the samples that were sent and with the load.
"""
