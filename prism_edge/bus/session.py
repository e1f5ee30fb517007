"""One process's place on the bus: a Zenoh session with the topics of topics.py (docs/TOPICS.md)."""

from __future__ import annotations

import atexit
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

import zenoh

from prism_edge.bus import codec, keys, leaving
from prism_edge.bus.another_run import AnotherRun
from prism_edge.bus.answer import Answer
from prism_edge.bus.commands import CommandDesk, Handler, Reply, send
from prism_edge.bus.inbox import Inbox
from prism_edge.bus.links import encoding, open_session, quality
from prism_edge.bus.presence import Presence
from prism_edge.bus.pulse import Pulse
from prism_edge.config import Config
from prism_edge.errors import BusError, first_line
from prism_edge.messages import IDS_A_LIFE
from prism_edge.topics import COMMANDS, TOPICS, Topic

log = logging.getLogger("prism_edge.bus")


class Bus:
    """Publishes, subscribes, answers and asks; a context manager. Every method may be called from any thread.

    The supervisor's session listens on the configured endpoint; those of the workers connect to it, learn of
    each other there (gossip) and then talk directly, over loopback listeners of their own. So a worker needs
    the supervisor to find the others, and no longer.
    """

    def __init__(self, session: Any, robot: str, process: str, lossless: bool) -> None:
        self.robot, self.process = robot, process
        self.life = 0  # how often this process was started before, in this run
        self.first_id = 0  # where it begins to number things: no number of an earlier life comes again
        self.run_directory: Path | None = None  # of the supervisor's run, where that started this process
        self.stopped = threading.Event()
        self._session, self._lossless = session, lossless
        self._lock = threading.RLock()
        self._publishers: dict[tuple[str, str], Any] = {}  # by topic, and who says what all say
        self._answers: dict[str, Answer] = {}
        self._last: dict[str, bytes | Callable[[], bytes]] = {}  # payloads of latched topics
        self._inboxes: list[Inbox] = []
        self._desks: list[CommandDesk] = []
        self._presence: Presence | None = None
        self._another_run: AnotherRun | None = None
        self._is_over = False  # this run: the robot has begun another
        self._tokens = [session.liveliness().declare_token(keys.alive_key(robot, process))]
        self._ready: list[Any] = []  # the token of a process that is ready, else none
        self._closed = False
        for name, topic in TOPICS.items():
            if topic.latched and topic.producer == process:
                self._answer_with_last(name)
        atexit.register(self.close)  # an open session would keep the process from ending
        self.pulse = Pulse(process, lambda beat: self.publish("heartbeat", beat), self._announce)

    @classmethod
    def open(cls, config: Config, process: str, listen: bool = False) -> Bus:
        """Joins the bus as ``process``; with ``listen``, as the one whom everybody connects to.

        Returns at once even where nobody listens yet. Raises ConfigError for a robot name that can't be part
        of a key, BusError for an endpoint that is malformed or in use.
        """
        keys.check_robot_name(config.robot)
        lossless = config.is_lockstep
        session = open_session(config.bus, listen, network=config.network, lossless=lossless)
        bus = cls(session, config.robot, process, lossless)
        if listen:  # who listens is the run
            run = keys.run_key(config.robot, str(session.zid()))
            bus._tokens.append(session.liveliness().declare_token(run))
        return bus

    def __enter__(self) -> Bus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def begin_life(self, life: int | None) -> None:
        """Say which life of the process this is; None for one started by hand, whose lives nobody counts.

        Such a one numbers things from the clock's microseconds on: more than it will ever give out.
        """
        self.life = life or 0
        self.first_id = time.time_ns() // 1000 if life is None else life * IDS_A_LIFE

    def publish(self, topic: str, message: Any) -> None:
        """Sends a dataclass of messages.py or a ROS message, whichever the topic carries.

        Raises BusError if it is of another type or has a value that the type does not allow. Once the robot
        has begun another run, whose keyframes have the numbers of this one's, only heartbeats are sent.
        """
        payload = _payload(TOPICS[topic], message)
        if self._is_over and topic != "heartbeat":
            return
        if TOPICS[topic].latched:
            self._last[topic] = payload
            self._answer_with_last(topic)
        try:
            self._publisher(topic, message.process if TOPICS[topic].of_all else "").put(payload)
        except zenoh.ZError as error:
            if not self._closed:
                raise BusError(f"can't publish {topic}: {error}") from None

    def publish_if_heard(self, topic: str, make: Callable[[], Any]) -> None:
        """As :meth:`publish`, of a message that is only made if somebody subscribes, or asks for it later.

        So ``make`` may be called in another thread, and must give the same whenever it is.
        """
        publisher = self._publisher(topic)
        try:
            heard = publisher.matching_status.matching
        except zenoh.ZError:  # closed meanwhile
            return
        if heard:
            self.publish(topic, make())
        elif TOPICS[topic].latched:
            self._last[topic] = lambda: _payload(TOPICS[topic], make())
            self._answer_with_last(topic)

    def forget(self, topic: str) -> None:
        """What was said last on a latched topic no longer holds: who asks is told nothing until the next."""
        self._last.pop(topic, None)

    def latest(self, topic: str) -> Inbox:
        """An inbox that keeps only the newest message."""
        return self.queue(topic, 1)

    def queue(self, topic: str, capacity: int = 256, rouses: Inbox | None = None) -> Inbox:
        """An inbox with every message in order. If it is full, the oldest is lost, counted and logged.

        What arrives ends a wait for something in the inbox that it ``rouses``.
        """
        key = keys.key(self.robot, TOPICS[topic])
        subscriber = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(capacity))
        inbox = Inbox(
            subscriber,
            capacity,
            lambda sample: self._unpack(topic, sample),
            self.stopped,
            (lambda: self._overflowed(topic)) if capacity > 1 else None,
            None if rouses is None else rouses.rouse,
        )
        with self._lock:
            self._inboxes.append(inbox)
        return inbox

    def answer(self, topic: str, function: Callable[[], Any | None]) -> None:
        """Answers get()s on the topic's key with what ``function`` returns (None: no answer).

        It is called in a thread of its own. Takes the place of the last value of a latched topic.
        """

        def payload() -> bytes | None:
            message = function()
            return None if message is None else _payload(TOPICS[topic], message)

        with self._lock:
            if topic in self._answers:
                self._answers.pop(topic).close()
            self._answers[topic] = self._reply_with(topic, payload)

    def ask(self, topic: str, timeout_s: float = 1.0) -> Any | None:
        """The last value of a topic, from whoever answers first; None if nobody does in time."""
        try:
            replies = self._session.get(
                keys.key(self.robot, TOPICS[topic]),
                timeout=timeout_s,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            for reply in replies:
                if reply.ok is not None:
                    return self._unpack(topic, reply.ok)
        except zenoh.ZError as error:
            log.warning("asking for %s failed: %s", topic, error)
        return None

    def commands(self, handlers: Mapping[str, Handler]) -> CommandDesk:
        """Takes commands of ``topics.COMMANDS``; they are done when the desk's ``serve`` is called."""
        desk = CommandDesk(self._session, self.robot, handlers)
        with self._lock:
            self._desks.append(desk)
        return desk

    def command(self, name: str, argument: str | None = None, timeout_s: float = 10.0) -> Reply:
        """Has a command done, and what came of it. Raises BusError where nobody answers in time."""
        return send(self._session, self.robot, COMMANDS[name], argument, timeout_s)

    def is_linked(self) -> bool:
        """Whether this session has a link to any other."""
        try:
            return bool(self._session.info.peers_zid() or self._session.info.routers_zid())
        except zenoh.ZError:  # closed meanwhile
            return False

    def on_another_run(self, begins: Callable[[], None]) -> None:
        """Have ``begins`` called, in a thread of its own, once the robot has begun another run than this."""

        def over() -> None:
            with self._lock:  # whoever waits for this process now waits for its next life
                self._is_over = True
                while self._ready:
                    self._ready.pop().undeclare()
            begins()

        with self._lock:
            if not self._closed:
                self._another_run = AnotherRun(self._session, self.robot, over)

    def await_ready(self, processes: Iterable[str], timeout_s: float) -> set[str]:
        """Waits until these processes are ready *and linked to this one*; returns those still missing.

        Messages published before that may not reach them. Ends early when the bus is stopped.
        """
        with self._lock:
            if self._presence is None and not self._closed:
                self._presence = Presence(self._session, self.robot, self.stopped)
        wanted = set(processes) - {self.process}
        return wanted if self._presence is None else self._presence.missing(wanted, timeout_s)

    def close(self) -> None:
        """Leaves the bus: ends the threads, undeclares everything, closes the session. Twice is no error."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self.stopped.set()
        self.pulse.close()
        for inbox in self._inboxes:
            inbox.close()
        for answer in self._answers.values():
            answer.close()
        for desk in self._desks:
            desk.close()
        if self._presence is not None:
            self._presence.close()
        if self._another_run is not None:
            self._another_run.close()
        # In lockstep nothing is to be lost for whoever reads slowly.
        leaving.leave(self._leave, None if self._lossless else leaving.PATIENCE_S)
        atexit.unregister(self.close)

    def _leave(self) -> None:
        try:
            for declared in (*self._tokens, *self._ready, *self._publishers.values()):
                declared.undeclare()
            self._session.close()
        except zenoh.ZError as error:
            log.warning("left the bus: %s", first_line(error))

    def _announce(self) -> None:
        with self._lock:
            if not self._is_over:
                key = keys.ready_key(self.robot, self.process)
                self._ready.append(self._session.liveliness().declare_token(key))

    def _publisher(self, topic: str, speaker: str = "") -> Any:
        declared = self._publishers.get((topic, speaker))
        if declared is not None:
            return declared
        with self._lock:
            if (topic, speaker) not in self._publishers:
                self._publishers[topic, speaker] = self._session.declare_publisher(
                    keys.key(self.robot, TOPICS[topic], speaker), **quality(TOPICS[topic], self._lossless)
                )
            return self._publishers[topic, speaker]

    def _answer_with_last(self, topic: str) -> None:
        with self._lock:
            if topic not in self._answers:
                self._answers[topic] = self._reply_with(topic, lambda: self._last_payload(topic))

    def _last_payload(self, topic: str) -> bytes | None:
        last = self._last.get(topic)
        return last() if callable(last) else last

    def _reply_with(self, topic: str, payload: Callable[[], bytes | None]) -> Answer:
        told = TOPICS[topic]

        def of_this_run() -> bytes | None:
            return None if self._is_over else payload()

        return Answer(self._session, keys.key(self.robot, told), of_this_run, encoding(told), told.internal)

    def _overflowed(self, topic: str) -> None:
        if self.pulse.count(f"lost {topic}") == 1:
            log.warning("%s messages come faster than they are taken: losing the oldest", topic)

    def _unpack(self, topic: str, sample: Any) -> Any | None:
        kind = TOPICS[topic].type
        data = sample.payload.to_bytes()
        try:
            message = _ros().deserialise(kind, data) if isinstance(kind, str) else codec.unpack(data, kind)
            if TOPICS[topic].of_all and not str(sample.key_expr).endswith(f"/{message.process}"):
                what = type(message).__name__
                raise BusError(f"malformed {what} message: in the name of {message.process!r:.40}")
            return message
        except BusError as error:
            if self.pulse.count("malformed") == 1:
                log.warning("%s: %s (more are only counted)", sample.key_expr, error)
            return None


def _ros() -> ModuleType:
    """ROS 2 types, which take a tenth of a second to load and which most processes never speak."""
    from prism_edge.bus import ros

    return ros


def _payload(topic: Topic, message: Any) -> bytes:
    if isinstance(topic.type, str):
        return _ros().serialise(topic.type, message)
    if type(message) is not topic.type:
        raise BusError(f"{topic.key} carries {topic.type.__name__}, not {type(message).__name__}")
    return codec.pack(message)
