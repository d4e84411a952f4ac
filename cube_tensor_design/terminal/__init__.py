"""Tables and progress of the design commands."""
