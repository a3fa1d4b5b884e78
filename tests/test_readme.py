"""What the README shows must run as shown."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_the_first_program_runs_and_leaves_its_picture(tmp_path):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    program = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)[0]
    assert len(program.strip().splitlines()) == 8
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "blurred.png").stat().st_size > 5_000


def test_every_file_the_readme_names_is_there():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    named = set(re.findall(r"scripts/[\w./]+\w", text)) | {"CHANGELOG.md", "CONTRIBUTING.md"}
    assert len(named) > 5
    missing = [name for name in sorted(named) if not (ROOT / name).exists()]
    assert missing == []
