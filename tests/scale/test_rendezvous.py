from prism_edge.scale.rendezvous import Rendezvous
from tests.scale.scene import depth_of, keyframe_of_wall


def keyframe(number, epoch=0):
    return keyframe_of_wall(number, 0.0, points=1, epoch=epoch)


def test_either_half_may_come_first_and_each_pair_comes_once():
    waiting = Rendezvous()
    waiting.add_depth(depth_of(keyframe(2)))
    assert waiting.complete() == []
    waiting.add_keyframe(keyframe(1))
    waiting.add_keyframe(keyframe(2))
    waiting.add_depth(depth_of(keyframe(1)))
    assert [(k.id, d.keyframe) for k, d in waiting.complete()] == [(1, 1), (2, 2)]
    assert waiting.complete() == []


def test_epochs_do_not_mix():
    waiting = Rendezvous()
    waiting.add_keyframe(keyframe(1, epoch=0))
    waiting.add_depth(depth_of(keyframe(1, epoch=1)))
    assert waiting.complete() == []


def test_the_oldest_are_dropped_and_counted():
    waiting = Rendezvous(capacity=3)
    for number in range(5):
        waiting.add_keyframe(keyframe(number))
    assert waiting.dropped == 2
    for number in range(5):
        waiting.add_depth(depth_of(keyframe(number)))
    assert waiting.dropped == 4
    assert [k.id for k, _ in waiting.complete()] == [2, 3, 4]


def test_a_keyframe_can_be_taken_without_depth():
    waiting = Rendezvous()
    waiting.add_keyframe(keyframe(7))
    assert waiting.take_keyframe(7).id == 7
    assert waiting.take_keyframe(7) is None


def test_of_two_epochs_keyframes_of_one_number_the_newer_is_taken():
    waiting = Rendezvous()
    for epoch in (0, 1):
        waiting.add_keyframe(keyframe(7, epoch))
    assert [waiting.take_keyframe(7).epoch for _ in range(2)] == [1, 0]
