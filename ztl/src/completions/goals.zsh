# The tasks of a server: `ztl complete-goal` asks it, and gives no answer to what is not a task.
_ztl_goals() {
    [[ $words[2] == (task-client|remote-task) ]] || return 1
    local -a goals
    goals=(${(f)"$($words[1] complete-goal -- "${(@Q)words[2,CURRENT-1]}" "$PREFIX" 2>/dev/null)"})
    (( $#goals )) || return 1
    compadd -S '' -- ${(M)goals:#*:}
    compadd -- ${goals:#*:}
    return 0
}

