// JeroMQ 0.3.6, which speaks as libzmq 3.2.5, as a client and as a server: see README.md.

import java.io.BufferedReader;
import java.io.InputStreamReader;
import java.nio.charset.StandardCharsets;
import java.util.ArrayList;
import java.util.Arrays;
import java.util.Base64;
import java.util.List;
import org.zeromq.ZMQ;

public final class Peer {
    static final int ACCEPTED = 1, REJECTED = 2, FAILED = 3, COMPLETED = 5;

    /** An answer, or a request: {@code scope;state;id;payload}. */
    static final class Message {
        final String scope, payload;
        final int state;
        final long id;

        Message(String scope, int state, long id, String payload) {
            this.scope = scope;
            this.state = state;
            this.id = id;
            this.payload = payload;
        }

        static Message parse(byte[] bytes) {
            String[] parts = new String(bytes, StandardCharsets.UTF_8).split(";", 4);
            return new Message(parts[0], Integer.parseInt(parts[1]), Long.parseLong(parts[2]), parts[3]);
        }

        byte[] encode() {
            String text = scope + ";" + state + ";" + id + ";" + payload;
            return text.getBytes(StandardCharsets.UTF_8);
        }
    }

    static String unhex(String word) {
        return new String(bytes(word), StandardCharsets.UTF_8);
    }

    static byte[] bytes(String word) {
        byte[] bytes = new byte[word.length() / 2];
        for (int i = 0; i < bytes.length; i++) {
            bytes[i] = (byte) Integer.parseInt(word.substring(2 * i, 2 * i + 2), 16);
        }
        return bytes;
    }

    static String hex(byte[] bytes) {
        StringBuilder word = new StringBuilder();
        for (byte b : bytes) {
            word.append(String.format("%02x", b));
        }
        return word.toString();
    }

    static void tell(long number, String text) {
        System.out.println(number + " " + hex(text.getBytes(StandardCharsets.UTF_8)));
    }

    static Message ask(ZMQ.Socket socket, String scope, int code, long id, String payload) {
        socket.send(new Message(scope, code, id, payload).encode(), 0);
        byte[] answer = socket.recv(0);
        if (answer == null) {
            throw new IllegalStateException("no answer within 60 s");
        }
        return Message.parse(answer);
    }

    static void client(ZMQ.Context context, String host, String port, String scope) throws Exception {
        ZMQ.Socket socket = context.socket(ZMQ.REQ);
        socket.setReceiveTimeOut(60000);
        socket.setSendTimeOut(60000);
        socket.setLinger(0);
        String address = "tcp://" + host + ":" + port;
        socket.connect(address);
        System.err.println("Remote task interface initialised at '" + address + "'.");
        BufferedReader in = new BufferedReader(new InputStreamReader(System.in, StandardCharsets.UTF_8));
        for (String line = in.readLine(); line != null; line = in.readLine()) {
            String[] words = line.split(" ", -1);
            if (words[0].equals("trigger")) {
                String task = unhex(words[1]) + ":" + unhex(words[2]) + ":" + unhex(words[3]);
                byte[] bytes = task.getBytes(StandardCharsets.UTF_8);
                String payload = Base64.getEncoder().encodeToString(bytes);
                Message answer = ask(socket, scope, 1, -1, payload);
                tell(answer.id, answer.payload);
                continue;
            }
            long id = Long.parseLong(words[1]);
            Message answer;
            if (words[0].equals("status")) {
                answer = ask(socket, scope, 2, id, "status update");
            } else if (words[0].equals("abort")) {
                answer = ask(socket, scope, 3, id, "abort command");
            } else {
                double seconds = Double.parseDouble(words[2]);
                long end = System.nanoTime() + (long) (seconds * 1e9);
                answer = ask(socket, scope, 2, id, "waiting poll");
                while (answer.state <= ACCEPTED && (seconds <= 0 || System.nanoTime() < end)) {
                    Thread.sleep(100);
                    answer = ask(socket, scope, 2, id, "waiting poll");
                }
            }
            tell(answer.state, answer.payload);
        }
        socket.close();
        context.term();
    }

    static final class Task {
        final String component, goal;
        final long ends;

        Task(String component, String goal) {
            this.component = component;
            this.goal = goal;
            long seconds = component.equals("sleep") ? Long.parseLong(goal) : 0;
            this.ends = System.nanoTime() + seconds * 1_000_000_000L;
        }
    }

    static Message answer(String ownScope, List<Task> tasks, Message request) {
        String scope = request.scope;
        if (!scope.equals(ownScope)) {
            return new Message(scope, REJECTED, -1, "No controller for scope: " + scope);
        }
        if (request.state == 1) {
            byte[] task = Base64.getDecoder().decode(request.payload);
            String[] parts = new String(task, StandardCharsets.UTF_8).split(":", 3);
            if (!parts[0].equals("test")) {
                return new Message(scope, REJECTED, -1, "No such handler '" + parts[0] + "', try 'test'.");
            }
            tasks.add(new Task(parts[1], parts[2]));
            return new Message(scope, ACCEPTED, tasks.size(), "Initiated");
        }
        if (request.id < 1 || request.id > tasks.size()) {
            return new Message(scope, REJECTED, request.id, "Invalid ID '" + request.id + "'");
        }
        Task task = tasks.get((int) request.id - 1);
        if (System.nanoTime() < task.ends) {
            return new Message(scope, ACCEPTED, request.id, request.state == 3 ? "False" : "None");
        }
        switch (task.component) {
            case "echo":
                return new Message(scope, COMPLETED, request.id, task.goal);
            case "sleep":
                return new Message(scope, COMPLETED, request.id, "True");
            default:
                return new Message(scope, FAILED, request.id, "No such component");
        }
    }

    static void server(ZMQ.Context context, String port, String scope) {
        ZMQ.Socket socket = context.socket(ZMQ.REP);
        socket.bind("tcp://*:" + port);
        System.out.println("Registering controller for scope '" + scope + "'.");
        List<Task> tasks = new ArrayList<>();
        while (true) {
            Message request = Message.parse(socket.recv(0));
            socket.send(answer(scope, tasks, request).encode(), 0);
        }
    }

    static void publisher(ZMQ.Context context, String port) throws Exception {
        ZMQ.Socket socket = context.socket(ZMQ.PUB);
        socket.bind("tcp://*:" + port);
        System.out.println("ready");
        BufferedReader in = new BufferedReader(new InputStreamReader(System.in, StandardCharsets.UTF_8));
        for (String line = in.readLine(); line != null; line = in.readLine()) {
            String[] frames = line.split(" ", -1);
            for (int i = 0; i < frames.length; i++) {
                socket.send(bytes(frames[i]), i + 1 < frames.length ? ZMQ.SNDMORE : 0);
            }
        }
    }

    static void subscriber(ZMQ.Context context, String port, String topic) {
        ZMQ.Socket socket = context.socket(ZMQ.SUB);
        socket.connect("tcp://127.0.0.1:" + port);
        socket.subscribe(topic.getBytes(StandardCharsets.UTF_8));
        while (true) {
            StringBuilder line = new StringBuilder(hex(socket.recv(0)));
            while (socket.hasReceiveMore()) {
                line.append(" ").append(hex(socket.recv(0)));
            }
            System.out.println(line);
        }
    }

    public static void main(String[] words) throws Exception {
        ZMQ.Context context = ZMQ.context(1);
        List<String> rest = Arrays.asList(words).subList(1, words.length);
        if (words[0].equals("client")) {
            client(context, rest.get(0), rest.get(1), rest.get(2));
        } else if (words[0].equals("publisher")) {
            publisher(context, rest.get(0));
        } else if (words[0].equals("subscriber")) {
            subscriber(context, rest.get(0), rest.get(1));
        } else {
            server(context, rest.get(1), rest.get(3));
        }
    }
}
