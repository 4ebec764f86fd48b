# fish completion for doractl(1). doractl itself says what fits: it knows its options and what runs.

function __doractl_complete
    set -l words (commandline --current-process --tokenize --cut-at-cursor)
    set -lx COMP_WORDS (string escape -- $words | string join ' ')
    set -lx COMP_CWORD (commandline --current-token --cut-at-cursor)
    set -lx _DORACTL_COMPLETE fish_complete
    # The values of an option are without --OPTION=, which fish expects.
    set -l before (string match --regex -- '^--[^=]+=' $COMP_CWORD)
    set -l path (string replace --regex -- '^--[^=]+=' '' $COMP_CWORD)
    for line in (doractl 2>/dev/null)
        set -l parts (string split --max 1 , -- $line)
        switch $parts[1]
            case plain
                echo "$before$parts[2]"
            case file
                __fish_complete_path $path | string replace --regex -- '^' "$before"
            case dir
                __fish_complete_directories $path | string replace --regex -- '^' "$before"
        end
    end
end

complete --no-files --command doractl --arguments '(__doractl_complete)'
