"""Scenes and random tasks that the tests of the planner share."""

from relevance.sampling import SceneConfig, sample_goals, sample_scene
from relevance.scene import PREDICATES, Box, Scene

RED, GREEN, BLUE, GREY = (0.8, 0.1, 0.1), (0.1, 0.7, 0.1), (0.1, 0.1, 0.8), (0.5, 0.5, 0.5)


def box(name, x, y, color=GREY, size=(0.05, 0.05, 0.06), *, bottom=0.0, **rest):
    return Box(name=name, size=size, position=(x, y, bottom + size[2] / 2), color=color, **rest)


OPEN = Scene(objects=(box("red", 0.0, 0.25, RED), box("blue", 0.0, -0.15, BLUE)))


def tasks(count, seed):
    """Random (scene, goal) pairs over all predicates, from fresh scenes."""
    found, index = [], 0
    predicates = list(PREDICATES.values())
    while len(found) < count:
        predicate = predicates[index % len(predicates)]
        config = SceneConfig(family=predicate.family)
        scene = sample_scene(config, seed=seed, index=index)
        index += 1
        if scene is not None:
            found += [(scene, goal) for goal in sample_goals(scene, predicate, 1, seed=seed)]
    return found[:count]


class Says:
    """Scores from a table."""

    def __init__(self, relevant):
        self.relevant = relevant

    def scores(self, scene, goal):
        return {name: 3.0 if name in self.relevant else -3.0 for name in scene.names}


class Given:
    """Scores by a rule."""

    def __init__(self, rule):
        self.rule = rule

    def scores(self, scene, goal):
        return {name: self.rule(i) for i, name in enumerate(scene.names)}
