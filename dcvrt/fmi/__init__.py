"""Any compiled system as a Functional Mock-up Unit: FMI 3.0, model exchange."""

from dcvrt.fmi.export import export

__all__ = ["export"]
