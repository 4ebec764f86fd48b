#!/bin/sh
# Runs inside the lab, as root; see autopkgtest.py.
set -eu

export PATH=/usr/sbin:/usr/bin:/sbin:/bin DEBIAN_FRONTEND=noninteractive
dpkg --install /src/dist/autopkgtest/*.deb >/dev/null
# It is bash's, and the shell of autopkgtest is not.
rm -f /root/.profile

tree=/srv/tree
cp -r /src "$tree"
rm -rf "$tree/dist" "$tree/.git"
cp -r "$tree/packaging/debian" "$tree/debian"

# This machine is made for one run: it may be broken, and nobody else's is. The nodes have what they
# need from PyPI already.
cd /
exec autopkgtest --ignore-restrictions=isolation-machine,breaks-testbed,needs-internet \
    /src/dist/dora-cli_*_"$(dpkg --print-architecture)".deb /src/dist/dora-systemd_*.deb \
    "$tree//" -- null
