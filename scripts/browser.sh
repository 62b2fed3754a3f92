#!/bin/bash
# Bring in a headless browser for the tests of pages, by apt-get as root. Does nothing where one is.
# Usage: scripts/browser.sh
set -euo pipefail
say() { echo "univoxel set-up: $*" >&2; }

for name in chromium chromium-browser google-chrome chrome; do
    command -v "$name" >/dev/null && exit 0
done
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
    say "no browser: please install what Debian calls chromium"
    exit 1
fi
say "apt-get install chromium"
export DEBIAN_FRONTEND=noninteractive
install() { apt-get install -y -q --no-install-recommends chromium </dev/null >&2; }
install || { apt-get update -q >&2 && install; }
