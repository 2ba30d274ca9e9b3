"""A Rerun recording as columns, for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader


class Recording:
    """A `.rrd` as columns: (entity, component) to the values in order of time."""

    def __init__(self, path: Path) -> None:
        self.reader = RrdReader(path)
        self.values: dict[tuple[str, str], list] = {}
        self.times: dict[str, list[int]] = {}
        rows: dict[tuple[str, str], list[tuple[int, object]]] = {}
        for chunk in self.reader.stream():
            batch = chunk.to_record_batch()
            assert set(chunk.timeline_names) <= {"time"}, "a timeline that tells the time of writing"
            stamps = np.zeros(batch.num_rows, np.int64)
            if "time" in batch.schema.names:
                stamps = np.asarray(batch.column("time")).astype(np.int64)
            for name in batch.schema.names:
                if ":" in name:
                    pairs = zip(stamps.tolist(), batch.column(name).to_pylist(), strict=True)
                    rows.setdefault((chunk.entity_path, name), []).extend(p for p in pairs if p[1] is not None)
        for key, pairs in rows.items():
            pairs.sort(key=lambda pair: pair[0])
            self.values[key] = [value for _, value in pairs]
            self.times.setdefault(key[0], [stamp for stamp, _ in pairs if stamp])

    def array(self, entity: str, component: str) -> np.ndarray:
        """All values of a component, one below the other."""
        return np.concatenate([np.asarray(value, dtype=np.float64) for value in self.values[entity, component]])

    @property
    def entities(self) -> set[str]:
        return {entity for entity, _ in self.values}
