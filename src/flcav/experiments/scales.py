"""Run recipes at the scale "quick" of experiments: the same pipeline on fewer frames."""

from flcav.runs.recipe import RunRecipe


def use_demo_size(recipe: RunRecipe) -> RunRecipe:
    """Return a recipe with the frames and steps of the demo."""
    return recipe.model_copy(update={"size": "demo"})


def shrink_recipe(recipe: RunRecipe) -> RunRecipe:
    """Return a recipe at toy size that shows that it runs, with plans that its few frames, anywhere, suffice for."""
    few = {"samples": 16, "edge_rounds": 1}
    tasks = {
        name: task.model_copy(update={"plan": task.plan.model_copy(update=few)}) if task.plan else task
        for name, task in recipe.tasks.items()
    }
    anywhere = recipe.placement.model_copy(update={"group_range_m": 1000.0})  # from a sensor
    changes = {"size": "toy", "splits": None, "training": None, "tasks": tasks, "placement": anywhere}
    return recipe.model_copy(update=changes)
