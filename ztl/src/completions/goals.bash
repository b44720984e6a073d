
# The tasks of a server: `ztl complete-goal` asks it, and gives no answer to what is not a task.
_ztl_goals() {
    case "${COMP_WORDS[1]}" in
    task-client | remote-task)
        COMPREPLY=()
        mapfile -t COMPREPLY < <("$1" complete-goal --line "${COMP_LINE:0:COMP_POINT}" "$2" 2>/dev/null) 2>/dev/null
        if ((${#COMPREPLY[@]})); then
            [[ ${COMPREPLY[0]} != *: ]] || compopt -o nospace
            return 0
        fi
        ;;
    esac
    _ztl "$@"
}
