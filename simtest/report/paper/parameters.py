"""The swept parameters of the published protocol: symbols, units and what their sweeps mean."""

from dataclasses import dataclass

from simtest.spec.recipes import PaperSetting

PREFIX = "paper."


@dataclass(frozen=True)
class Parameter:
    """How a parameter is written."""

    name: str  # its name in `PaperSetting`
    symbol: str
    words: str
    unit: str = ""
    factor: float = 1.0  # shown value over the value in the rows
    about: str = ""  # what its sweep means

    @property
    def axis_title(self) -> str:
        """Title of the axis, with symbol and unit."""
        return f"{self.words} {self.symbol}" + (f" ({self.unit})" if self.unit else "")

    def text(self, value: object) -> str:
        """Write a value of the rows with symbol and unit."""
        if self.name == "recentre":
            return "window at the BP" if value else "window at the foot"
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"{self.symbol}\u00a0=\u00a0{value}"
        unit = {"%": "\u00a0%", "deg": "°", "px": "\u00a0px"}.get(self.unit.split(" ")[0], "")
        return f"{self.symbol}\u00a0=\u00a0{value * self.factor:.6g}{unit}"


_KNOWN = (
    Parameter(
        "sigma", "σ", "noise", "% of the noise-free peak", 100.0,
        "More noise on the camera's picture. What is left at σ = 0 is the smoothing's bias, and noise adds to it; the "
        "bound, which knows no bias, starts at 0, and an estimator with a bias may fall below it.",
    ),
    Parameter(
        "theta_deg", "θ", "slant", "deg", 1.0,
        "The plane turned away from the camera. Towards θ = 0 the circle is seen as a circle: circle pose is at its "
        "branch point, where a relative axis error δ already tilts the normal by √(2δ), so this rise belongs to the "
        "model. Towards 90° the picture of the texture is a few pixels high, its window cuts the isophote and the "
        "realisations fail: this is truncation, not the model.",
    ),
    Parameter(
        "exponent", "n", "roughness exponent", "", 1.0,
        "A glossier plane has a smaller highlight: fewer pixels carry the isophote, and the same smoothing is a larger "
        "share of it.",
    ),
    Parameter(
        "isovalue", "t", "isovalue", "share of the smoothed peak", 1.0,
        "Where the isophote is taken. A low one is wide but faint: noise moves it far, and below the brightness at the "
        "edge of the texture's window it does not close, which is truncation and counted as failures. A high one is "
        "small and lies where the lobe is flat.",
    ),
    Parameter(
        "eps", "ε", "light offset", "texture units", 1.0,
        "The light beside the camera: the isophote is no circle any more, and what grows with ε is the model's error. "
        "With the texture's window centred at the brightest point the isophote stays inside; with the window left at "
        "the camera's foot it runs out of it: the failures and the steep rise are truncation, not the model.",
    ),
    Parameter(
        "smoothing_px", "s", "smoothing width", "px", 1.0,
        "The width of the smoothing, which the article does not state. A narrow one leaves noise, a wide one rounds "
        "the ellipse: its bias grows with s² and is the floor that no number of realisations removes.",
    ),
    Parameter("size", "M", "picture and texture side", "px"),
    Parameter("height", "V_Z", "camera height", "texture units"),
    Parameter("recentre", "", "place of the window"),
)  # fmt: skip

PARAMETERS = {parameter.name: parameter for parameter in _KNOWN}  # by name; every field of `PaperSetting` has one
DEFAULTS = PaperSetting().model_dump()  # the article's defaults by name
