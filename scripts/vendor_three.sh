#!/bin/bash
# Fetch three.js again and bundle what the page uses of it into univoxel/output/web/vendor/. The
# bundle is committed: nobody but whoever changes the version or three_entry.js needs npm.
# Usage: scripts/vendor_three.sh
set -euo pipefail
cd "$(dirname "$0")/.."
three=0.187.0 esbuild=0.28.2
work=$PWD/build/three vendor=$PWD/univoxel/output/web/vendor

rm -rf "$work" && mkdir -p "$work/node_modules/three" "$work/esbuild"
cd "$work"
npm pack --silent "three@$three" "@esbuild/linux-x64@$esbuild" >/dev/null
sha256sum --quiet --check - <<SUMS
ff540832ded0cfe919764d24a3d88f3e2a05f23303f876423e4f893841e90728  three-$three.tgz
9573bb2233aab0f9ea7647d5cca9726113cc1768de61d66b17267f4db84488f6  esbuild-linux-x64-$esbuild.tgz
SUMS
tar -xzf "three-$three.tgz" -C node_modules/three --strip-components=1
tar -xzf "esbuild-linux-x64-$esbuild.tgz" -C esbuild --strip-components=1
cp ../../scripts/three_entry.js entry.js
# A classic script: modules do not load from file://
esbuild/bin/esbuild entry.js --bundle --minify --format=iife --global-name=THREE --target=es2020 \
    --charset=utf8 --legal-comments=inline --outfile="$vendor/three.min.js" --log-level=warning
cp node_modules/three/LICENSE "$vendor/LICENSE"
cat >"$vendor/README.md" <<README
three.js $three, MIT (LICENSE). \`three.min.js\` holds what \`scripts/three_entry.js\` names of the
package \`three\`, bundled and minified by esbuild $esbuild with \`scripts/vendor_three.sh\`, which
checks the packages' sums. sha256 of the bundle:

    $(cd "$vendor" && sha256sum three.min.js)
README
