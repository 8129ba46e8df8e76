#!/usr/bin/env bash
# The CI of the example projects against the wheel of this checkout, in a fresh virtual environment
# that has nothing else: `make example`. PYTHON needs `build` and setuptools.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-python3}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export PIP_CONSTRAINT=$root/constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1

# A copy of what is in git or will be: what earlier builds have left here would get into the wheel.
mkdir "$work/source"
git -C "$root" ls-files -z --cached --others --exclude-standard |
  tar -C "$root" --null --files-from=- --ignore-failed-read -c | tar -C "$work/source" -x
"$python" -m build --wheel --no-isolation --outdir "$work" "$work/source" >"$work/build.log" 2>&1 ||
  { cat "$work/build.log"; exit 1; }
wheel=$(echo "$work"/hil-*.whl)
packages() { find hil "$@" -type f | sed -E 's#^(drivers|mock_robot)/##' | sort; }
here=$(cd "$work/source" && packages drivers/hil_drivers mock_robot/hil_mock_robot)
packed=$(cd "$work" && "$python" -m zipfile -e "$wheel" packed && cd packed && packages hil_drivers hil_mock_robot)
diff <(echo "$here") <(echo "$packed") || { echo "the wheel has not what the checkout has"; exit 1; }
echo "built $(basename "$wheel"): $(echo "$packed" | wc -l) files, all that the checkout has"

"$python" -m venv "$work/venv"
export PATH=$work/venv/bin:$PATH VIRTUAL_ENV=$work/venv
unset PYTHONPATH
python -m pip install --quiet "hil[testing,ur,can] @ file://$wheel"
for project in "$work"/source/examples/*/; do
  "$project/ci.sh"
done
