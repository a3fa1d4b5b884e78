#!/usr/bin/env bash
# Make a small data set of the built-in scenes and a contact sheet to look at.  bash scripts/demo.sh [options of the generator]
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
.venv/bin/python scripts/generate_dataset.py --out out/demo --count 12 --width 256 --height 256 --seed 1 \
    --source primitives --frames-per-clip 2 --workers 2 "$@"
echo "look at out/demo/contact_sheet.png"
