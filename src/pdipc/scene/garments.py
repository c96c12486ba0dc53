"""What a scene file may say about garments and closed cloth."""

from pydantic import Field, model_validator

from pdipc.scene.tables import NotNegative, Number, Positive, Table


class Inside(Table):
    """What every closed part of a cloth holds; one of pressure, gas and bulk_modulus.

    With V its volume and V0 `volume`, it pushes outward with `pressure`, with gas (V0 / V)^exponent - outside, or with
    bulk_modulus (1 - V / V0), Pa.
    """

    pressure: Number | None = Field(
        default=None, description="Constant pressure above that outside, Pa; below it where negative."
    )
    gas: Positive | None = Field(
        default=None, description="Pressure at which a gas fills `volume`, Pa; that outside is not taken off it."
    )
    exponent: Positive = Field(
        default=1.0, le=5.0, description="Of a gas: 1 at constant temperature, 1.4 for air without heat exchange."
    )
    outside: NotNegative = Field(default=101325.0, description="Pressure outside, which a gas works against, Pa.")
    bulk_modulus: Positive | None = Field(
        default=None, le=1e12, description="Of a liquid, Pa: a load of p changes the volume by the part p / bulk_modulus."
    )
    volume: Positive | None = Field(
        default=None, description="What the gas or liquid fills, m^3, of each closed part; absent: the volume at the start."
    )
    start: NotNegative = Field(default=0.0, description="When filling begins, s: before, nothing pushes.")
    rise: NotNegative = Field(
        default=0.0,
        description="How long filling takes, s: pressure, gas above outside, or volume, grow evenly to what is given.",
    )

    @model_validator(mode="after")
    def _check(self) -> "Inside":
        given = [name for name in ("pressure", "gas", "bulk_modulus") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"exactly one of pressure, gas, bulk_modulus is needed; given: {', '.join(given) or 'none'}")
        for name, owner in (("exponent", "gas"), ("outside", "gas")):
            if (
                name in self.model_fields_set
                and given != [owner]
                and getattr(self, name) != type(self).model_fields[name].default
            ):
                raise ValueError(f"{name} has no effect on {given[0]}; it belongs to {owner}")
        if self.volume is not None and self.pressure is not None:
            raise ValueError("volume has no effect on a constant pressure; leave it out")
        return self

    def law(self, time: float, volume: float) -> tuple[float, float, float, float, float]:
        """a, b, g, k, V0 of `constraints.enclosed_volume` at `time`, s. volume: that at the start, m^3."""
        part = 1.0 if self.rise == 0.0 else min(1.0, max(0.0, (time - self.start) / self.rise))
        if time < self.start:
            part = 0.0
        filled = self.volume or volume
        if self.pressure is not None:
            return part * self.pressure, 0.0, 1.0, 0.0, volume
        if self.gas is not None:
            # until it is filled there is as much gas as keeps the volume of the start
            begin = self.outside * (volume / filled) ** self.exponent
            return -self.outside, begin + part * (self.gas - begin), self.exponent, 0.0, filled
        assert self.bulk_modulus is not None
        return 0.0, 0.0, 1.0, self.bulk_modulus, volume + part * (filled - volume)
