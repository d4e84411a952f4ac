"""Driver for the cubic stress tensor sensor: pad frequencies in, stress tensors and gradients
out."""

import pkgutil

# The generated messages live in the install space, the sources may be elsewhere: one package sees
# both.
__path__ = pkgutil.extend_path(__path__, __name__)
