"""The judge of torture: compares what a skin published with what its simulated hubs did.

One comparison per file; `verdict.py` puts them together. What was sent comes from the sample log,
what arrived from the judge's own record of both topics. What the driver counts is a claim that is
checked. The judge looks at nothing before everything has come, so that it is never late itself.

Nothing here imports ROS, and nothing receives: `trials/torture.py` does.
"""
