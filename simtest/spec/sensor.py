"""The sensor of a scene: what turns radiance into a frame."""

from pydantic import Field

from simtest.spec.reading import Spec


class Sensor(Spec):
    """Noise of the frame."""

    noise_sigma: float = Field(0.0, ge=0, le=1, description="standard deviation of the noise, share of full scale")
    seed: int = Field(0, ge=0, lt=2**63, description="seed of the noise; experiments draw one for each realisation")
