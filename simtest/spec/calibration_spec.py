"""The tables of a calibration file: a camera with its response, vignetting, emission and noise."""

from pydantic import Field, model_validator

from simtest.calibration import Calibration, NoiseModel, Normal, Priors, Response, exactly
from simtest.geometry import Camera
from simtest.spec.camera_spec import CameraSpec
from simtest.spec.falloff import CosineProfile, Profile
from simtest.spec.sensor import Bits, FullWell, ReadNoise, ResponseSpec, check_electrons
from simtest.spec.spec_model import Coordinate, Millimetres, Spec


class SensorCalibration(Spec):
    """What is known of the sensor's noise and range."""

    full_well: FullWell | None = Field(None, description="electrons at full scale")
    read_noise: ReadNoise = Field(0.0, description="standard deviation, electrons")
    bits: Bits | None = Field(None, description="of the values")
    saturation_level: float | None = Field(
        None, gt=0, le=1e6, description="value, share of the largest, at and above which a pixel counts as clipped"
    )

    @model_validator(mode="after")
    def _electrons(self) -> "SensorCalibration":
        check_electrons(self.full_well, self.read_noise)
        return self


class RigCalibration(Spec):
    """What is known of the lights and of the working distance."""

    lights_mm: tuple[tuple[Coordinate, Coordinate, Coordinate], ...] = Field(
        (), max_length=32, description="positions of the lights, camera frame, mm; default not known"
    )
    distance_mm: Millimetres | None = Field(
        None, description="working distance along the sightline, mm: measured, or the middle of what is expected"
    )
    distance_sd_mm: float = Field(0.0, ge=0, le=1e6, description="standard deviation of the true distance, mm")

    @model_validator(mode="after")
    def _about_a_distance(self) -> "RigCalibration":
        if self.distance_sd_mm > 0 and self.distance_mm is None:
            raise ValueError(f"distance_sd_mm = {self.distance_sd_mm:g}: needs distance_mm")
        return self


class SurfaceCalibration(Spec):
    """What is known of the surface's lobe."""

    phong_exponent: float | None = Field(None, gt=0, le=1e5, description="roughness exponent n; default not known")


class CalibrationSpec(Spec):
    """A calibration file; all tables but the camera may be left out."""

    camera: CameraSpec
    response: ResponseSpec | None = Field(None, description="how light became values; default: not stated")
    vignetting: Profile = Field(
        CosineProfile(), description="share of the light that the lens passes, over the angle from the optical axis"
    )
    emission: Profile = Field(
        CosineProfile(), description="of a light at the camera, shining along the optical axis, over the same angle"
    )
    sensor: SensorCalibration = SensorCalibration()
    rig: RigCalibration = RigCalibration()
    surface: SurfaceCalibration = SurfaceCalibration()

    def calibration(self, camera: Camera) -> Calibration:
        """Return a camera with all that the file states beside it; the camera's own table has been read before."""
        # A response that is not stated counts as linear in the noise model, but stays unknown in the calibration.
        response = self.response.model() if self.response is not None else None
        sensor = self.sensor
        noise = NoiseModel(0.0, sensor.full_well, sensor.read_noise, sensor.bits, response or Response())
        falloff = (self.vignetting.model(), self.emission.model())
        return Calibration(camera, response, *falloff, noise, sensor.saturation_level, self.priors())

    def priors(self) -> Priors:
        """Return the priors on lights, distance and lobe."""
        rig, exponent = self.rig, self.surface.phong_exponent
        distance = None if rig.distance_mm is None else Normal(rig.distance_mm, rig.distance_sd_mm)
        if exponent is None:
            return Priors(rig.lights_mm, distance)
        # Imported here: the reflectances are slower to load than the whole calibration.
        from simtest.spec.reflectance import PhongReflectance

        lobe = exactly(PhongReflectance(exponent=exponent).lobe_curvature)
        return Priors(rig.lights_mm, distance, lobe)
