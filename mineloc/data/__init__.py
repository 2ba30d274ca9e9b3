"""The nouns: what the rooms hand to each other. Frozen, checked at birth, arrays read-only.

Frames: `map` (gravity-levelled, z up), `odom` (`map` before any correction), `body` (the drone; what trajectories
place), `imu`, `lidar`, `camera`. Times are integer nanoseconds since the epoch.
"""

from mineloc.data.arrays import F32 as F32
from mineloc.data.arrays import F64 as F64
from mineloc.data.arrays import I32 as I32
from mineloc.data.arrays import I64 as I64
from mineloc.data.arrays import U8 as U8
from mineloc.data.arrays import U16 as U16
from mineloc.data.arrays import Bool as Bool
from mineloc.data.camera import CameraModel as CameraModel
from mineloc.data.camera import DepthImage as DepthImage
from mineloc.data.camera import GreyImage as GreyImage
from mineloc.data.control import ControlPoint as ControlPoint
from mineloc.data.control import Observation as Observation
from mineloc.data.estimate import Degeneracy as Degeneracy
from mineloc.data.estimate import Fix as Fix
from mineloc.data.estimate import Keyframe as Keyframe
from mineloc.data.estimate import OdometryStep as OdometryStep
from mineloc.data.estimate import RelativePose as RelativePose
from mineloc.data.flight import Calibration as Calibration
from mineloc.data.flight import FlightInfo as FlightInfo
from mineloc.data.flight import Trajectory as Trajectory
from mineloc.data.intersections import Intersection as Intersection
from mineloc.data.intersections import IntersectionDatabase as IntersectionDatabase
from mineloc.data.intersections import IntersectionKind as IntersectionKind
from mineloc.data.intersections import Lineage as Lineage
from mineloc.data.intersections import Sight as Sight
from mineloc.data.intersections import WallContour as WallContour
from mineloc.data.map_cloud import MapCloud as MapCloud
from mineloc.data.map_cloud import SurfaceKind as SurfaceKind
from mineloc.data.sweep import ImuSamples as ImuSamples
from mineloc.data.sweep import Sweep as Sweep
