#!/bin/sh
# Checks the package /tmp/ztl.deb in an empty Debian root: `cargo xtask test --only deb` runs this there.
set -eux
list() { { find / -xdev ! -path '/tmp/*' -printf '%p %y %m %u:%g %l\n'; find / -xdev -type f ! -path '/tmp/*' -exec sha256sum {} +; } |
    grep -Ev '(^|  )/(etc/((passwd|group|shadow|gshadow)-|\.pwd\.lock)|var/lib/dpkg/status-old|var/log/|run/)' | sort; }
list > /tmp/before

dpkg --install /tmp/ztl.deb
ztl --version
for command in $(ztl --help | sed -n '/^Commands:/,/^$/s/^  \([a-z-]*\) .*/\1/p' | grep -vx help); do
    test -s /usr/share/man/man1/ztl-$command.1.gz
    grep -q "^ *ztl,$command)" /usr/share/bash-completion/completions/ztl
    grep -q "($command)" /usr/share/zsh/vendor-completions/_ztl
    grep -q -- "-a \"$command\"" /usr/share/fish/vendor_completions.d/ztl.fish
done
bash -c '. /usr/share/bash-completion/completions/ztl && complete -p ztl | grep -w _ztl_goals'
grep -q "complete-goal --" /usr/share/zsh/vendor-completions/_ztl
grep -q "complete-goal --" /usr/share/fish/vendor_completions.d/ztl.fish
id --name --groups ztl | grep -w dialout
test -s /usr/share/doc/ztl/copyright
test -s /usr/lib/udev/rules.d/60-ztl.rules
mkdir --mode 700 /var/lib/ztl && chown ztl: /var/lib/ztl
timeout 60 runuser --user ztl -- env HOME=/var/lib/ztl ztl demo --once --port 0

dpkg --install /tmp/ztl.deb
dpkg --purge ztl
list > /tmp/after
# A line with `>` is a trace that the package leaves.
diff /tmp/before /tmp/after
