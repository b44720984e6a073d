"""A robot's services in libqi itself: names and signatures of NAO, on its own service directory or on another one.

    robot.py directory ENDPOINT SERVICE...
    robot.py process DIRECTORY SERVICE...

Prints `ready ENDPOINT`, then does what each line of stdin says, and answers with a line.
"""

import sys
import threading
import time

import qi

ANY = qi.Dynamic


def said(text):
    print(text, flush=True)


@qi.multiThreaded()
class ALTextToSpeech:
    def __init__(self):
        self.stopped = threading.Event()

    @qi.bind(returnType=qi.Void, paramsType=(qi.String,))
    def say(self, text):
        is_long = text == "a long story"
        if is_long:
            # A stop may follow as soon as it is printed.
            self.stopped.clear()
        said("say " + text)
        if is_long:
            self.stopped.wait(60)
            said("silent")

    @qi.bind(returnType=qi.Void, paramsType=())
    def stopAll(self):
        self.stopped.set()

    @qi.bind(returnType=qi.Void, paramsType=(qi.String,))
    def setLanguage(self, language):
        raise RuntimeError("language " + language + " is not installed")


@qi.multiThreaded()
class ALMotion:
    def __init__(self):
        self.stiffness = qi.Property("f")
        self.stiffness.setValue(0.0)
        self.stopped = threading.Event()

    @qi.bind(returnType=qi.Void, paramsType=(qi.List(qi.String), qi.List(qi.Float), qi.List(qi.Float), qi.Bool))
    def angleInterpolation(self, names, angles, times, absolute):
        said("angles %s %s %s %s" % (names, angles, times, absolute))

    @qi.bind(returnType=qi.Bool, paramsType=(qi.Float, qi.Float, qi.Float))
    def moveTo(self, x, y, theta):
        is_far = x == 2.0
        if is_far:
            self.stopped.clear()
        said("move %s %s %s" % (x, y, theta))
        return not is_far or not self.stopped.wait(60)

    @qi.bind(returnType=qi.Void, paramsType=())
    def stopMove(self):
        said("stopped")
        self.stopped.set()

    @qi.bind(returnType=qi.Void, paramsType=())
    def killAll(self):
        said("killed")

    @qi.bind(returnType=qi.Void, paramsType=())
    def wakeUp(self):
        said("awake")

    @qi.bind(returnType=qi.Void, paramsType=())
    def rest(self):
        said("rests")

    @qi.bind(returnType=qi.Void, paramsType=(ANY, ANY))
    def setStiffnesses(self, names, stiffnesses):
        said("stiffnesses %s %s" % (names, stiffnesses))

    @qi.bind(returnType=qi.Bool, paramsType=(qi.Int32,))
    def killTask(self, task):
        return task == 7

    @qi.bind(returnType=qi.List(qi.Float), paramsType=(ANY, qi.Bool))
    def getAngles(self, names, sensors):
        return [0.5] * len(names)


@qi.multiThreaded()
class ALAnimationPlayer:
    def __init__(self):
        # A promise that nobody holds is broken.
        self.promises = []

    def cancelled(self, promise):
        said("cancelled")
        promise.setCanceled()

    @qi.bind(paramsType=(qi.String,))
    def run(self, animation):
        promise = qi.Promise(self.cancelled)
        self.promises.append(promise)
        said("run " + animation)
        if animation == "short":
            threading.Timer(0.3, lambda: promise.setValue("over")).start()
        return promise.future()


@qi.multiThreaded()
class ALLeds:
    @qi.bind(returnType=qi.String, paramsType=(qi.String, qi.Int32, qi.Float), methodName="fadeRGB")
    def fade_number(self, group, rgb, duration):
        return "number %d" % rgb

    @qi.bind(returnType=qi.String, paramsType=(qi.String, qi.String, qi.Float), methodName="fadeRGB")
    def fade_name(self, group, color, duration):
        return "name " + color

    @qi.bind(returnType=qi.String, paramsType=qi.AnyArguments)
    def anything(self, *values):
        return repr(values)

    @qi.bind(returnType=qi.String, paramsType=(ANY,))
    def shown(self, value):
        return repr(value)

    @qi.bind(returnType=ANY, paramsType=(ANY,))
    def echo(self, value):
        return value

    @qi.bind(returnType="(sf)<Touch,part,force>", paramsType=())
    def touch(self):
        return ("Head", 0.25)


@qi.multiThreaded()
class ALAnimatedSpeech:
    @qi.bind(returnType=qi.Void, paramsType=(qi.String,))
    def say(self, text):
        said("animated " + text)


@qi.multiThreaded()
class ALRobotPosture:
    @qi.bind(returnType=qi.Bool, paramsType=(qi.String, qi.Float))
    def goToPosture(self, posture, speed):
        said("posture %s %s" % (posture, speed))
        return posture != "LyingBelly"

    @qi.bind(returnType=qi.Void, paramsType=())
    def stopMove(self):
        pass


@qi.multiThreaded()
class ALAutonomousLife:
    @qi.bind(returnType=qi.Void, paramsType=(qi.String,))
    def setState(self, state):
        said("life " + state)


@qi.multiThreaded()
class ALBehaviorManager:
    def __init__(self):
        self.stopped = threading.Event()

    @qi.bind(returnType=qi.Void, paramsType=(qi.String,))
    def runBehavior(self, name):
        self.stopped.clear()
        said("behavior " + name)
        self.stopped.wait(60)

    @qi.bind(returnType=qi.Void, paramsType=(qi.String,))
    def stopBehavior(self, name):
        said("stop " + name)
        self.stopped.set()


@qi.multiThreaded()
class ALTabletService:
    @qi.bind(returnType=qi.Bool, paramsType=(qi.String,))
    def showWebview(self, url):
        said("page " + url)
        return True

    @qi.bind(returnType=qi.Void, paramsType=())
    def hideWebview(self):
        said("no page")


@qi.multiThreaded()
class ALSpeechRecognition:
    @qi.bind(returnType=qi.Void, paramsType=(qi.List(qi.String), qi.Bool))
    def setVocabulary(self, words, spotting):
        said("words %s %s" % (words, spotting))

    @qi.bind(returnType=qi.Void, paramsType=(qi.String,))
    def subscribe(self, name):
        said("hears " + name)

    @qi.bind(returnType=qi.Void, paramsType=(qi.String, qi.Int32, qi.Float), methodName="subscribe")
    def subscribe_often(self, name, period, precision):
        said("hears %s often" % name)

    @qi.bind(returnType=qi.Void, paramsType=(qi.String,))
    def unsubscribe(self, name):
        said("deaf to " + name)


class ALSonar(ALSpeechRecognition):
    pass


class ALPeoplePerception(ALSpeechRecognition):
    pass


class Subscriber:
    def __init__(self):
        self.signal = qi.Signal("m")


@qi.multiThreaded()
class ALMemory:
    def __init__(self):
        self.subscribers = {}
        self.changed = qi.Signal("(si)")

    @qi.bind(returnType=qi.Object, paramsType=(qi.String,))
    def subscriber(self, key):
        if key not in self.subscribers:
            self.subscribers[key] = Subscriber()
        return self.subscribers[key]

    @qi.nobind
    def raise_event(self, key, value):
        self.subscriber(key).signal(value)


class Odd:
    """Values of a type that cannot be sent."""

    @qi.bind(returnType="X", paramsType=())
    def gives(self):
        return 1

    @qi.bind(returnType=qi.Void, paramsType=("X",))
    def takes(self, value):
        pass


class Other:
    """Any other service."""

    def name(self):
        return "other"


KINDS = {
    kind.__name__: kind
    for kind in (
        ALAnimatedSpeech,
        ALAnimationPlayer,
        ALAutonomousLife,
        ALBehaviorManager,
        ALLeds,
        ALMemory,
        ALMotion,
        ALPeoplePerception,
        ALRobotPosture,
        ALSonar,
        ALSpeechRecognition,
        ALTabletService,
        ALTextToSpeech,
        Odd,
    )
}


class Robot:
    def __init__(self, session):
        self.session = session
        self.services = {}

    def register(self, name):
        service = KINDS.get(name, Other)()
        number = self.session.registerService(name, service)
        self.services[name] = (number, service)

    def do(self, words):
        command, rest = words[0], words[1:]
        if command == "register":
            for name in rest:
                self.register(name)
        elif command == "many":
            for number in range(int(rest[0])):
                self.register("Service%03d" % number)
        elif command == "unregister":
            self.session.unregisterService(self.services.pop(rest[0])[0])
        elif command == "raise":
            self.services["ALMemory"][1].raise_event(rest[0], eval(" ".join(rest[1:])))
        elif command == "flood":
            for number in range(int(rest[0])):
                self.services["ALMemory"][1].changed("flood", number)
        elif command == "stiffness":
            said("stiffness %s" % self.services["ALMotion"][1].stiffness.value())
        elif command == "time":
            # How long calls of libqi itself take, in microseconds, sorted.
            other = qi.Session()
            other.connect(self.session.endpoints()[0])
            leds = other.service("ALLeds")
            times = []
            for _ in range(int(rest[0])):
                start = time.perf_counter()
                leds.fadeRGB("FaceLeds", 255, 0.5)
                times.append(time.perf_counter() - start)
            said("p50 %d" % (sorted(times)[len(times) // 2] * 1e6))
            other.close()
        said("done " + command)


def main():
    mode, endpoint, names = sys.argv[1], sys.argv[2], sys.argv[3:]
    session = qi.Session()
    if mode == "directory":
        session.listenStandalone(endpoint)
    else:
        session.connect(endpoint)
        session.listen("tcp://127.0.0.1:0")
    robot = Robot(session)
    for name in names:
        robot.register(name)
    said("ready %s" % session.endpoints()[0])
    for line in sys.stdin:
        robot.do(line.split())


main()
