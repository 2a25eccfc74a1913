"""Pictures of a registration."""


def draw_registration(result, scene, data, initial):
    return {}
