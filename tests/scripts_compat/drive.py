"""Plays scripts with the original's engine and with another one, both on a terminal of their own with
the same keys, against servers that write down every request; prints one JSON object a script.

argv: the other engine, a seed, how many scripts to make up, how many to play at once.
Scripts of stdin, as JSON {name: [text, keys]}, come first.
"""
import base64, fcntl, json, os, pty, random, re, signal, struct, sys, tempfile, termios, time
import zmq
import ztl.cmd.run_script as original

# What a component's tasks do: for how long, and their end.
LASTS = {'blink': (0, 5), 'wave': (.5, 5), 'walk': (1, 5), 'fail': (.5, 3), 'gone': (.5, 4)}
RUNNING, PATIENCE = 1, 90


def end_of(component):
    return next((end for name, end in LASTS.items() if component.startswith(name)), (0, 5))


class Play:
    """One engine plays one script."""

    def __init__(self, context, directory, name, text, keys, ours):
        self.name, self.ours, self.keys = name, ours, list(keys)
        self.socket = context.socket(zmq.ROUTER)
        port = self.socket.bind_to_random_port('tcp://127.0.0.1')
        self.tasks, self.requests, self.out, self.prompts = {}, [], b'', 0
        path = os.path.join(directory, '%s-%s' % (name, 'ours' if ours else 'original'))
        with open(path + '.yaml', 'w') as file:
            file.write(text)
        with open(path + '-remotes.yaml', 'w') as file:
            names = ['robot', 'lamp', 'other', 'Grüße']
            remotes = {n: {'host': '127.0.0.1', 'port': port, 'scope': '/' + str(i)} for i, n in enumerate(names)}
            json.dump({'remotes': remotes}, file, ensure_ascii=False)
        args = ['run-script', '-s', path + '.yaml', '--config', path + '-remotes.yaml']
        errors = os.open(path + '.err', os.O_WRONLY | os.O_CREAT)
        self.errors = path + '.err'
        self.begun = time.monotonic()
        self.pid, self.terminal = pty.fork()
        if self.pid == 0:
            try:
                os.dup2(errors, 2)
                if ours:
                    os.execv(ours, [ours] + args + ['--plain'])
                sys.argv = args
                original.main_cli()
                sys.stdout.flush()
                os._exit(0)
            except SystemExit as exit:
                sys.stdout.flush()
                os._exit(exit.code or 0)
            except BaseException as error:
                os.write(2, repr(error).encode())
                os._exit(1)
        os.close(errors)
        # Wide enough that no line is broken.
        fcntl.ioctl(self.terminal, termios.TIOCSWINSZ, struct.pack('HHHH', 50, 4000, 0, 0))

    def serve(self):
        while self.socket.poll(0):
            *route, body = self.socket.recv_multipart()
            scope, code, mid, payload = body.decode().split(';', 3)
            now = time.monotonic()
            self.socket.send_multipart([*route, self.answer(now, scope, int(code), mid, payload).encode()])

    def answer(self, now, scope, code, mid, payload):
        if not scope.startswith('/'):
            return '%s;2;-1;No controller for scope: %s' % (scope, scope)
        if code == 1:
            payload = base64.b64decode(payload).decode()
        self.requests.append((now - self.begun, scope, code, mid, payload))
        if code == 1:
            component = payload.split(':')[1]
            number = self.tasks[scope] = self.tasks.get(scope, 0) + 1
            if component.startswith('refuse'):
                return '%s;3;-1;Controller threw exception: no' % scope
            lasts, end = end_of(component)
            self.tasks[scope, str(number)] = (now + lasts, end)
            return '%s;1;%d;taken' % (scope, number)
        ends, end = self.tasks[scope, mid]
        state, text = (end, 'True') if now >= ends else (RUNNING, 'None')
        return '%s;%d;%s;%s' % (scope, state, mid, text)

    def read(self):
        """Takes what the engine writes; whether it goes on."""
        try:
            data = os.read(self.terminal, 65536)
        except OSError:
            data = b''
        self.out += data
        return bool(data)

    def press(self):
        """Answers a prompt, when the terminal waits for a single key."""
        if (b'\n' + self.out).count(b'\nPRESS <') <= self.prompts:
            return
        if termios.tcgetattr(self.terminal)[3] & termios.ICANON:
            return
        self.prompts += 1
        key = self.keys.pop(0) if self.keys else 'x'
        os.write(self.terminal, key.encode())

    def end(self):
        _, status = os.waitpid(self.pid, 0)
        os.close(self.terminal)
        self.socket.close(0)
        with open(self.errors, errors='replace') as file:
            errors = file.read()
        return {
            'exit': os.waitstatus_to_exitcode(status),
            'out': self.out.decode(errors='replace').replace('\r\n', '\n'),
            'err': errors,
            'requests': self.requests,
        }


def made_up(dice):
    """A script and keys for it."""
    names = ['look', 'go', 'say it', 'stand by', 'äh']
    wait = ['wait=%s' % w for w in ('no', 'false', 'yes', 'True', ' on', 'ture', '0')]

    def key(name, delays, more):
        pieces = []
        if dice.random() < .12 and delays:
            pieces.append(dice.choice(['delay=1', 'delay = 1', 'delay=0', 'delay=-1', 'delay=+1']))
        if dice.random() < .3 and more:
            pieces.append(dice.choice(more))
        if dice.random() < .1:
            pieces.append(dice.choice(['x=1', 'x', 'a=b=c', '']))
        dice.shuffle(pieces)
        return name + ('(%s)' % ','.join(pieces) if pieces or dice.random() < .05 else '')

    goals = [1, 1.5, True, None, 'text', "it's", [0, 0, 1.57], {'a': 1, 'b': ['x', 'ü']}, '12:30', '010', 'a: b']
    raw = ['on', '1e3', '0x1F', '12:30', '2020-01-01', '~', '[yes, no]', '{1: 2, k: v}', '1.0e+3', '.5', '"q\\t"', "'s'"]
    lines = []
    for scene in range(dice.randint(1, 2)):
        lines.append('%s:' % json.dumps(key('scene %d' % scene, True, []), ensure_ascii=False))
        for step in range(dice.randint(1, 3)):
            lines.append('  %s:' % json.dumps(key('%s %d' % (dice.choice(names), step), True, wait), ensure_ascii=False))
            for handler in dice.sample(['robot', 'lamp', 'other', 'Grüße', 'a(remote=robot)', 'b(x=1, remote = lamp)'], dice.randint(1, 2)):
                lines.append('    %s:' % json.dumps(handler, ensure_ascii=False))
                for part in dice.sample(['blink', 'blink too', 'wave', 'walk', 'fail', 'gone', 'refuse'], dice.randint(1, 2)):
                    goal = dice.choice(raw) if dice.random() < .5 else json.dumps(dice.choice(goals))
                    lines.append('      %s: %s' % (json.dumps(key(part, True, wait)), goal))
    keys = [dice.choice(['\r', '\r', '\r', '\r', 'r', ' ', '\n', 'R']) for _ in range(3)] + dice.choice([['x'], ['a'], ['r'], []])
    return '\n'.join(lines) + '\n', keys


def main():
    engine, seed, count, at_once = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    dice = random.Random(seed)
    todo = list(json.load(sys.stdin).items())
    todo += [('made-%d' % i, made_up(dice)) for i in range(count)]
    todo = [(name, text, keys, ours) for name, (text, keys) in todo for ours in (None, engine)]
    todo.reverse()
    context, running, done = zmq.Context(), [], {}
    with tempfile.TemporaryDirectory() as directory:
        while todo or running:
            if todo and len(running) < at_once:
                name, text, keys, ours = todo.pop()
                running.append(Play(context, directory, name, text, keys, ours))
                done.setdefault(name, {'name': name, 'text': text, 'keys': keys})
            poller = zmq.Poller()
            for play in running:
                poller.register(play.socket, zmq.POLLIN)
                poller.register(play.terminal, zmq.POLLIN)
            ready = dict(poller.poll(0 if todo and len(running) < at_once else 10))
            for play in list(running):
                if play.socket in ready:
                    play.serve()
                goes_on = play.terminal not in ready or play.read()
                if goes_on and time.monotonic() - play.begun > PATIENCE:
                    os.kill(play.pid, signal.SIGKILL)
                elif goes_on:
                    play.press()
                else:
                    running.remove(play)
                    done[play.name]['ours' if play.ours else 'original'] = play.end()
                    if len(done[play.name]) == 5:
                        print(json.dumps(done.pop(play.name)), flush=True)


main()
