# bash completion for doractl(1). doractl itself says what fits: it knows its options and what runs.

_doractl() {
    local kind value
    COMPREPLY=()
    while IFS=, read -r kind value; do
        case $kind in
            plain) COMPREPLY+=("$value") ;;
            file) compopt -o default 2>/dev/null ;;
            dir) compopt -o dirnames 2>/dev/null ;;
        esac
    done < <(COMP_WORDS="${COMP_WORDS[*]}" COMP_CWORD=$COMP_CWORD \
        _DORACTL_COMPLETE=bash_complete doractl 2>/dev/null)
}

complete -o nosort -F _doractl doractl
