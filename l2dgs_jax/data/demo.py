"""The clip that comes with the package; `shelf/README.md` says where it is from."""

from pathlib import Path

FOLDER = Path(__file__).parent / "shelf"
