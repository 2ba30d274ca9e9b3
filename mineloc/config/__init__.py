"""The configuration: frozen sections with units in the key names; unknown keys are errors at every depth.

A TOML file holds any subset of the sections; `--set section.key=value` overrides one key. The canonical JSON of the
result is part of every stage's key in the store.
"""

from mineloc.config.configuration import Config as Config
from mineloc.config.configuration import layered_config as layered_config
from mineloc.config.configuration import load_config as load_config
from mineloc.config.configuration import read_toml as read_toml
from mineloc.config.configuration import validate as validate
from mineloc.config.estimation import GraphConfig as GraphConfig
from mineloc.config.estimation import KeyframeConfig as KeyframeConfig
from mineloc.config.estimation import LoamConfig as LoamConfig
from mineloc.config.estimation import OdometryConfig as OdometryConfig
from mineloc.config.estimation import SweepConfig as SweepConfig
from mineloc.config.features import Link3dConfig as Link3dConfig
from mineloc.config.features import ScanContextConfig as ScanContextConfig
from mineloc.config.intersections import IntersectionsConfig as IntersectionsConfig
from mineloc.config.localizing import PriorMapConfig as PriorMapConfig
from mineloc.config.mapping import ControlConfig as ControlConfig
from mineloc.config.mapping import FusionConfig as FusionConfig
from mineloc.config.mapping import LoopsConfig as LoopsConfig
from mineloc.config.mapping import MapConfig as MapConfig
from mineloc.config.recordings import IngestConfig as IngestConfig
from mineloc.config.recordings import SimulateConfig as SimulateConfig
from mineloc.config.reporting import EvaluateConfig as EvaluateConfig
from mineloc.config.reporting import ReportConfig as ReportConfig
from mineloc.config.reporting import ViewConfig as ViewConfig
from mineloc.config.section import Section as Section
