"""The native engine: fault simulation of a whole grid with derivatives, in compiled code."""
