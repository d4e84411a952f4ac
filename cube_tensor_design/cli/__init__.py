"""The commands fem, study and paper."""
