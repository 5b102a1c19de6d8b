#!/usr/bin/env bash
# Installs the system packages that some tests use, where it may; names them in one line where not.
set -euo pipefail

missing=()
command -v mosquitto >/dev/null || [ -x /usr/sbin/mosquitto ] || missing+=(mosquitto)
command -v nginx >/dev/null || [ -x /usr/sbin/nginx ] || missing+=(nginx)
command -v chromium >/dev/null || missing+=(chromium)
command -v node >/dev/null || missing+=(nodejs)
command -v npm >/dev/null || missing+=(npm)
command -v systemd-analyze >/dev/null || missing+=(systemd)
command -v initdb >/dev/null || compgen -G "/usr/lib/postgresql/*/bin/initdb" >/dev/null ||
  missing+=(postgresql)
command -v gpsfake >/dev/null || missing+=(gpsd gpsd-clients gpsd-tools)
command -v chronyd >/dev/null || [ -x /usr/sbin/chronyd ] || missing+=(chrony)
[ ${#missing[@]} -eq 0 ] && exit 0

as_root=""
[ "$(id -u)" = 0 ] || as_root="sudo -n"
if command -v apt-get >/dev/null && { [ -z "$as_root" ] || sudo -n true 2>/dev/null; }; then
  echo "setup: installing ${missing[*]} for the tests"
  export DEBIAN_FRONTEND=noninteractive
  # shellcheck disable=SC2086
  if $as_root apt-get update -qq >/dev/null 2>&1 &&
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
      "${missing[@]}" >/dev/null 2>&1; then
    exit 0
  fi
fi
echo "setup: tests that need ${missing[*]} are skipped; as root: apt-get install ${missing[*]}" >&2
