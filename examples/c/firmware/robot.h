/* The desk robot: connects robot.c with a board's pins. */
#ifndef ROBOT_H
#define ROBOT_H

#include <ztl_node.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Its components: a stage and a lamp. */
#define ROBOT_COMPONENTS 2
extern const ztl_component robot_components[ROBOT_COMPONENTS];

/* Provided by the board: move the stage to a position in tenths of a millimetre; switch the lamp. */
void board_place(int tenths);
void board_lamp(int on);

#ifdef __cplusplus
}
#endif

#endif
