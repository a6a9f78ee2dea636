# Set-up shared by scripts/demo and scripts/test; to be sourced.
#
# JAXMAP_VENV    folder of the virtual environment (default: .venv in the repository)
# JAXMAP_PYTHON  interpreter to make it with (default: the first fit one on PATH)

ROOT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
VENV=${JAXMAP_VENV:-$ROOT/.venv}
case $VENV in /*) ;; *) VENV=$PWD/$VENV ;; esac
PYTHON=$VENV/bin/python
# Lies in the environment while pip works, so that a run that was killed meanwhile is noticed.
UNFINISHED=$VENV/.jaxmap-unfinished

say() { printf 'jaxmap: %s\n' "$*" >&2; }
die() { printf 'error: %s\n' "$*" >&2; exit 1; }

# Whether an interpreter runs and is new enough; pyenv leaves commands on PATH that do neither.
is_fit_python() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1
}

# Sets BASE_PYTHON to an interpreter that can make a virtual environment with pip in it.
find_python() {
    local candidate version without_pip="" candidates=(python3.13 python3.12 python3.11 python3 python)
    if [ -n "${JAXMAP_PYTHON:-}" ]; then candidates=("$JAXMAP_PYTHON"); fi
    for candidate in "${candidates[@]}"; do
        command -v "$candidate" >/dev/null 2>&1 && is_fit_python "$candidate" || continue
        if "$candidate" -c 'import ensurepip, venv' >/dev/null 2>&1; then
            BASE_PYTHON=$candidate
            return
        fi
        without_pip=${without_pip:-$candidate}
    done
    if [ -n "$without_pip" ]; then
        version=$("$without_pip" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        die "$without_pip lacks ensurepip, so it makes no virtual environments;" \
            "on Debian or Ubuntu: apt-get install python$version-venv"
    fi
    die "no Python 3.11 or newer among: ${candidates[*]}; install one, or name one with JAXMAP_PYTHON"
}

# Makes the environment anew where it is missing or broken.
make_venv() {
    if [ ! -e "$UNFINISHED" ] && is_fit_python "$PYTHON"; then
        "$PYTHON" -m pip --version >/dev/null 2>&1 && return
        # Other tools leave pip out of the environments they make.
        "$PYTHON" -m ensurepip >/dev/null 2>&1 && "$PYTHON" -m pip --version >/dev/null 2>&1 && return
    fi
    if [ -n "${JAXMAP_VENV:-}" ] && [ ! -e "$VENV/pyvenv.cfg" ] && [ -n "$(ls -A "$VENV" 2>/dev/null)" ]; then
        die "$VENV holds other files and is no virtual environment; point JAXMAP_VENV at an empty or new folder"
    fi
    find_python
    say "making a virtual environment in $VENV"
    "$BASE_PYTHON" -m venv --clear "$VENV" || die "no virtual environment made in $VENV; the reason stands above"
}

# What an installation depends on: once any of it changes, the package is installed again.
fingerprint() {
    printf '%s\n%s\n' "$ROOT" "$VENV"
    "$PYTHON" -c 'import sys; print(sys.version)' 2>/dev/null || echo "no python"
    cat "$ROOT/pyproject.toml" "$ROOT/constraints.txt" | cksum
}

is_installed() {
    [ ! -e "$UNFINISHED" ] && [ "$(cat "$VENV/.jaxmap-installed-$1" 2>/dev/null)" = "$(fingerprint)" ]
}

# prepare_venv run|test: an environment with the package, and for `test` with the tools of the tests.
prepare_venv() {
    local kind=$1 target=$ROOT
    if is_installed "$kind"; then return; fi
    # Two first runs at a time take turns; the second one then finds the work done.
    mkdir -p "$(dirname "$VENV")"
    if command -v flock >/dev/null 2>&1; then
        exec 9>"$VENV.lock"
        flock 9
        if is_installed "$kind"; then exec 9>&-; return; fi
    fi
    make_venv
    if [ "$kind" = test ]; then target="${ROOT}[test]"; fi
    say "installing into $VENV (the first time takes a few minutes)"
    : >"$UNFINISHED"
    if ! "$PYTHON" -m pip install --quiet --disable-pip-version-check --no-input \
        --constraint "$ROOT/constraints.txt" --editable "$target" </dev/null 1>&2; then
        # pip undoes what fails; only what was killed is to be made anew.
        rm -f "$UNFINISHED"
        die "the installation failed; pip's reason stands above"
    fi
    fingerprint >"$VENV/.jaxmap-installed-$kind"
    if [ "$kind" = test ]; then cp "$VENV/.jaxmap-installed-test" "$VENV/.jaxmap-installed-run"; fi
    rm -f "$UNFINISHED"
    exec 9>&-
}
