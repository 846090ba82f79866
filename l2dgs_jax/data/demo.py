"""The demo clip that comes with the package; `shelf/README.md` names its source."""

from pathlib import Path

FOLDER = Path(__file__).parent / "shelf"
