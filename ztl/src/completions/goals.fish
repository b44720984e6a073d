
# The tasks of a server: `ztl complete-goal` asks it, and gives no answer to what is not a task.
function __fish_ztl_goals
    set -l words (commandline -opc) (commandline -ct)
    $words[1] complete-goal -- $words[2..] 2>/dev/null
end
complete -c ztl -n "__fish_ztl_using_subcommand task-client remote-task" -f -a '(__fish_ztl_goals)'
