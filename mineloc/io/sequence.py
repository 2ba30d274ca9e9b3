"""A sequence file: what a recording does not say about itself, or says wrongly. See `datasets/README.md`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from mineloc import se3
from mineloc.config import Section, read_toml, validate
from mineloc.data import Calibration, FlightInfo

F64 = NDArray[np.float64]
Vector = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]
Quaternion = Annotated[tuple[float, ...], Field(min_length=4, max_length=4)]


class Topics(Section):
    """Names of the topics; empty means: the only one of its type, `none`: leave it out."""

    lidar: str = ""
    imu: str = ""
    reference: str = Field(default="", description="Odometry, PoseStamped, PoseWithCovarianceStamped or TF")
    odometry: str = Field(default="", description="odometry kept beside the reference")
    depth: str = Field(default="", description="Image, 16UC1 or 32FC1, with CameraInfo beside it")
    grey: str = Field(
        default="", description="Image, grey or colour, or CompressedImage (JPEG), with CameraInfo beside"
    )


class LidarRules(Section):
    """How the clouds are to be read; `auto` is decided on the first sweeps and then held."""

    sensor: str = ""
    rate_hz: float | None = Field(default=None, gt=0, le=100, description="revolutions a second")
    times: Literal["auto", "field", "none", "azimuth"] = Field(
        default="auto", description="azimuth: made from the angle where the points are in firing order"
    )
    time_field: str = Field(default="", description="name of the field, where it has an unusual one")
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    time_kind: Literal["auto", "relative", "absolute"] = "auto"
    header: Literal["auto", "start", "end"] = Field(
        default="auto", description="which point of the sweep header.stamp is the time of"
    )
    clock: Literal["lidar", "header"] = Field(
        default="lidar", description="header: absolute times of an unsynchronised clock are shifted to header.stamp"
    )
    rings: Literal["auto", "field", "none", "elevation"] = "auto"
    ring_field: str = Field(default="", description="name of the field, where it has an unusual one")
    ring_count: int | None = Field(default=None, ge=1, le=256)


class ImuRules(Section):
    """Units of the inertial samples. ROS asks for m/s²; some drivers write multiples of standard gravity."""

    accel_unit: Literal["mps2", "g"] = "mps2"
    gyro_unit: Literal["radps", "degps"] = "radps"


class ReferenceRules(Section):
    """What the reference places, and in which frame."""

    places: Literal["body", "lidar", "imu"] = "body"
    parent_frame: str = Field(default="", description="TF only: header.frame_id of the transform to take")
    child_frame: str = Field(default="", description="TF and Odometry: child_frame_id to take")
    shift_s: float = Field(default=0.0, description="added to the reference's stamps")


class Mounting(Section):
    """A pose of a sensor in `body`."""

    translation_m: Vector = (0.0, 0.0, 0.0)
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)

    @field_validator("quaternion_xyzw")
    @classmethod
    def _of_unit_length(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if abs(float(np.linalg.norm(value)) - 1.0) > 1e-3:
            raise ValueError("a quaternion of length 1")
        return value

    def transform(self) -> F64:
        """The (4, 4) transform from the sensor's coordinates to those of `body`."""
        return se3.from_xyzw(self.translation_m, self.quaternion_xyzw)


class Mountings(Section):
    """Where the sensors sit on the drone."""

    lidar: Mounting = Mounting()
    imu: Mounting = Mounting()
    camera: Mounting | None = Field(default=None, description="of the optical frame: x right, y down, z ahead")


class FlightFacts(Section):
    """Facts for the `mineloc.flight` record."""

    flight: str = ""
    site: str = ""
    level: str = ""
    drone: str = ""
    lidar: str = ""
    imu: str = ""
    operator: str = ""
    start_utc: str = ""
    calibration: str = ""


class Sequence(Section):
    """The whole file. Every key may be left out."""

    name: str = ""
    topics: Topics = Topics()
    lidar: LidarRules = LidarRules()
    imu: ImuRules = ImuRules()
    reference: ReferenceRules = ReferenceRules()
    T_body: Mountings = Field(
        default=Mountings(), description="[T_body.lidar], [T_body.imu], …: sensors placed in body"
    )
    flight: FlightFacts = FlightFacts()

    @property
    def calibration(self) -> Calibration:
        """Where the sensors sit."""
        camera = self.T_body.camera
        return Calibration(
            self.T_body.lidar.transform(),
            self.T_body.imu.transform(),
            None if camera is None else camera.transform(),
        )

    @property
    def T_places_body(self) -> F64:
        """Takes body coordinates to those of what the reference places: `T_map_body = reference @ T_places_body`."""
        if self.reference.places == "body":
            return np.eye(4)
        mounting = self.T_body.lidar if self.reference.places == "lidar" else self.T_body.imu
        return se3.inverse(mounting.transform())

    def flight_info(self, *, source: str) -> FlightInfo:
        """The facts of the flight; `source` is the recording's name."""
        facts = self.flight.model_dump()
        facts["lidar"] = facts["lidar"] or self.lidar.sensor
        return FlightInfo(**facts, source=source)


def load_sequence(path: Path) -> Sequence:
    """Read a sequence file.

    Raises:
        ConfigError: no such file, not TOML, an unknown key, a value that does not fit.
    """
    return validate(Sequence, read_toml(path), where=str(path))
