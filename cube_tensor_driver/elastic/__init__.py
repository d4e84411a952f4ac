"""The elastomer: response matrices by finite elements, contact fields, a virtual bench."""
