"""The stages of a survey. Named, not imported: planning and finding known results load nothing heavy."""

from __future__ import annotations

from mineloc.stages.stage import Stage

SIMULATE = Stage("simulate", 1, "mineloc.stages.simulate:simulate", ("simulate",))
INGEST = Stage("ingest", 1, "mineloc.stages.ingest:ingest", ("ingest",))
LOCALIZE = Stage(
    "localize",
    1,
    "mineloc.stages.localize:localize",
    ("sweep", "keyframe", "odometry", "loam", "link3d", "scan_context", "loops", "graph", "prior_map", "intersections"),
    volatile=frozenset({"timing.json"}),
)
RECONSTRUCT = Stage(
    "reconstruct",
    1,
    "mineloc.stages.reconstruct:reconstruct",
    ("sweep", "keyframe", "odometry", "loam", "link3d", "scan_context", "loops", "graph", "fusion", "control", "map"),
    volatile=frozenset({"timing.json"}),
)
DATABASE = Stage("database", 1, "mineloc.stages.database:database", ("intersections", "map"))
EVALUATE = Stage("evaluate", 1, "mineloc.survey.score:score", ("evaluate",))
RECORD = Stage("record", 1, "mineloc.view.run:record_run", ("evaluate", "view"))
REPORT = Stage("report", 1, "mineloc.report.page:write_report", ("evaluate", "report"), inside="report.html")
