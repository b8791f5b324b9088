from setuptools import setup

NAME = "quad_swarm_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/swarm.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Nodes and launch files for quadrotors that plan, ask each other for plans, and avoid each other",
    license="MIT",
    entry_points={
        "console_scripts": [
            "robot = quad_swarm.ros.robot_node:main",
            "plant = quad_swarm.ros.plant_node:main",
        ]
    },
)
