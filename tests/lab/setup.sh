#!/bin/sh
# Runs once in the new tree, as root, in a chroot: everything that packages do not do.
set -eu

for user in alice:1000 bob:1001; do
    useradd --create-home --uid "${user#*:}" --shell /bin/bash "${user%:*}"
    install -d /var/lib/systemd/linger
    touch "/var/lib/systemd/linger/${user%:*}"
done

# An empty machine-id would make every boot a first boot, with presets and all.
echo 6c61622d646f72612d73797374656d64 > /etc/machine-id
echo lab > /etc/hostname
printf '127.0.0.1 localhost lab\n::1 localhost\n' > /etc/hosts
: > /etc/fstab
install -d -g systemd-journal -m 2755 /var/log/journal

cat > /etc/profile.d/lab.sh <<'PROFILE'
PATH=/opt/lab/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
PROFILE
cat > /root/.bashrc <<'BASHRC'
PS1='\[\e[1m\]lab:\w\$\[\e[0m\] '
[ -r /usr/share/bash-completion/bash_completion ] && . /usr/share/bash-completion/bash_completion
BASHRC
echo '[ -r ~/.bashrc ] && . ~/.bashrc' > /root/.profile

# The services of the lab come and go within a second: none needs these, and each costs boot time.
systemctl set-default multi-user.target
systemctl mask \
    apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer fstrim.timer man-db.timer \
    e2scrub_all.timer e2scrub_reap.service systemd-tmpfiles-clean.timer \
    console-getty.service getty@tty1.service serial-getty@ttyS0.service getty-static.service \
    dev-hugepages.mount dev-mqueue.mount sys-kernel-debug.mount sys-kernel-tracing.mount \
    sys-kernel-config.mount sys-fs-fuse-connections.mount proc-sys-fs-binfmt_misc.automount \
    modprobe@drm.service modprobe@fuse.service modprobe@configfs.service \
    ldconfig.service systemd-binfmt.service systemd-firstboot.service \
    systemd-hwdb-update.service systemd-journal-catalog-update.service \
    systemd-modules-load.service systemd-networkd.service systemd-pstore.service \
    ssh.service ssh.socket systemd-random-seed.service systemd-timesyncd.service systemd-update-done.service
journalctl --update-catalog
touch /etc/.updated /var/.updated

# Each reload of systemd's configuration runs all generators, a process each; one of them may matter.
install -d /etc/systemd/system-generators
for generator in /usr/lib/systemd/system-generators/*; do
    [ "${generator##*/}" = systemd-fstab-generator ] ||
        ln -s /dev/null "/etc/systemd/system-generators/${generator##*/}"
done
