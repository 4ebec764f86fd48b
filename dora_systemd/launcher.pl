#!/usr/bin/perl
# Dora's daemon executes this instead of a node's program. The process becomes the node later, so it
# can enter the node's group and open the node's pipes first, without a race. The node then gets the
# environment that dora made for it, without the variables that are only for dora's daemon.
#
# launcher.pl NODE DIRECTORY pipe|keep COMMAND [ARGUMENT...]
#   pipe: stdout and stderr become the node's FIFOs; opening them waits for the runner.
#   keep: dora itself reads the output (send_stdout_as, send_logs_as).
#   :USEC behind it: the node has a notify socket, and if not 0 a watchdog, see
#   sd_watchdog_enabled(3); :any behind that: another process of the node may feed it.
# Environment: DORA_SYSTEMD_CELL (RuntimeDirectory), DORA_SYSTEMD_GROUP (cgroup of the unit),
# DORA_SYSTEMD_LIBEXEC (first entry of PATH), DORA_SYSTEMD_UNSET (names), DORA_SYSTEMD_RIGHTS (lines
# NODE WORD..., the programs that set the rights of the node or of "*", all others),
# DORA_SYSTEMD_SIGACTION (number of rt_sigaction(2) on this machine).
#
# Perl, because a shell drops variables with names such as "my.var" and sets others (PWD, OLDPWD),
# and because Python takes six times as long and ignores signals. No modules: "use strict" would
# double the time.

my ($node, $directory, $output, @command) = @ARGV;
my ($cell, $group, $libexec, $unset, $rights, $sigaction) =
    delete @ENV{map "DORA_SYSTEMD_$_", qw(CELL GROUP LIBEXEC UNSET RIGHTS SIGACTION)};
# KEEP is from runners of older versions.
delete @ENV{split(' ', $unset), map "DORA_SYSTEMD_$_", qw(DIRECTORY PYTHON KEEP)};

sub fail {
    my ($status, $what) = @_;
    print STDERR "launcher of $node: $what: $!\n";
    exit $status;
}

sub note {
    my ($path, $text) = @_;
    my $file;
    (open $file, '>', $path and print $file $text and close $file) or fail(126, $path);
}

note("$cell/io/$node.pid", "$$\n");
# Before the pipes: the kernel lets this move wait for some 10 ms, and the runner needs them to get
# ready for the pipes.
note("$group/node-$node/cgroup.procs", "0\n");
($output, my ($usec, $any)) = split /:/, $output;
if (defined $usec) {
    $ENV{NOTIFY_SOCKET} = "$cell/io/$node.notify";
    delete @ENV{qw(WATCHDOG_USEC WATCHDOG_PID)};
    $ENV{WATCHDOG_USEC} = $usec if $usec;
    $ENV{WATCHDOG_PID} = $$ if $usec and not $any;
}
if ($output eq 'pipe') {
    open STDOUT, '>', "$cell/io/$node.out" or fail(126, "$node.out");
    open STDERR, '>', "$cell/io/$node.err" or fail(126, "$node.err");
}
# A node with needs has a gate, see runner/nodes/launcher_gates.py: the runner writes words of three
# bytes when the node may go on, or has to end. Without a word the gate was closed again.
my $gate = "$cell/io/$node.gate";
while (-p $gate) {
    open my $fifo, '<', $gate or fail(126, "$node.gate");
    sysread $fifo, my $word, 3 or next;
    last if $word eq 'go.';
    kill hex substr($word, 1), $$ if $word =~ /^s/;
    exit hex substr($word, 1);
}
chdir $directory or fail(126, $directory);
$ENV{PATH} =~ s/^\Q$libexec\E://;
# A zenoh configuration of the user's takes precedence. Dora refuses two, and a file that it cannot
# read.
(my $zenoh = $0) =~ s{[^/]*$}{zenoh.json5};
unless (exists $ENV{ZENOH_CONFIG} or exists $ENV{DORA_ZENOH_CONFIG_OVERLAY} or not -r $zenoh) {
    $ENV{DORA_ZENOH_CONFIG_OVERLAY} = $zenoh;
}
# Python then prints its stack to stderr when a signal such as SIGSEGV ends it: `doractl why` shows it.
$ENV{PYTHONFAULTHANDLER} = 1 unless exists $ENV{PYTHONFAULTHANDLER};
if (defined $rights and ($rights =~ /^\Q$node\E (.*)$/m or $rights =~ /^\* (.*)$/m)) {
    unshift @command, split ' ', $1;
}
# RestrictNamespaces= forbids clone3(2), and without it posix_spawn(3) of the daemon makes its children
# ignore the signals that glibc keeps for itself. Only the system call gives their default back.
if ($sigaction) {
    my $default = "\0" x 32;
    syscall($sigaction + 0, $_, $default, 0, 8) for 32, 33;
}
exec { $command[0] } @command;
fail($! == 2 ? 127 : 126, $command[0]);  # ENOENT, as in a shell
